"""Conversion of experiment files of Robotic Park's authors.

May import: agents, twins, experiments.catalogue, experiments.file, experiments.check, experiments.definition.
"""
