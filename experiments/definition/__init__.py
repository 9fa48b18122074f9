"""Definition of an experiment: the structs of its file, and what follows for robots, bodies and network.

May import: agents, twins, experiments.arrays.
"""
