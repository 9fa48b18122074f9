"""Consistency of an experiment: contradictions between fields, each with its path in the file.

May import: agents, bridges, twins, experiments.definition, experiments.file.problems, experiments.file.choices,
experiments.file.structure.
"""
