"""The view in a browser (`./zenpark view`): a live run as an observer sees it, a recording, or a paced virtual run.

May import: agents, twins, experiments.arrays, experiments.definition, experiments.file, experiments.recording,
experiments.metrics, experiments.scene, experiments.virtual_time, experiments.real_time.
"""
