"""Environments of learning over experiments in virtual time; pettingzoo and gymnasium are the extra `learn`.

May import: agents, experiments.cores, experiments.definition, experiments.file, experiments.metrics,
experiments.virtual_time, twins.arrays.
"""
