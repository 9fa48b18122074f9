"""From a trace to numbers.

May import: agents, twins, experiments.arrays, experiments.definition, experiments.recording.
"""
