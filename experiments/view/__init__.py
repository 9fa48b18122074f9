"""The view in a browser (`./zenpark view`): a live run as an observer sees it, or a recording.

May import: agents, twins, experiments.arrays, experiments.definition, experiments.file, experiments.recording,
experiments.metrics, experiments.scene, experiments.real_time.
"""
