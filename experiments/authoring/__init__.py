"""Sources of experiment files: generated formations, the files of Robotic Park, and those of Crazyswarm2.

May import: agents, twins, experiments.catalogue, experiments.definition, experiments.file, experiments.check,
experiments.authoring.robotic_park, bridges.crazyflie.protocol.
"""
