"""Processes of a run: zygote, robot, recorder, world, central controller, protocol twins.

May import: agents, twins, experiments.definition, experiments.file, experiments.recording, experiments.scene.
"""
