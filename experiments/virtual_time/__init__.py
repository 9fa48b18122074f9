"""The virtual clock: simulation, its network and its log, as a trace or a recording.

May import: agents, twins, experiments.arrays, experiments.definition, experiments.recording, experiments.scene,
experiments.virtual_time.translator.
"""
