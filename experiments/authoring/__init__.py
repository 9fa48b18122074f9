"""Sources of experiment files: generated formations, and the files of Robotic Park.

May import: agents, twins, experiments.catalogue, experiments.definition, experiments.file, experiments.check.
"""
