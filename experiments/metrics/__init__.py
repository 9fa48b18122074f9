"""From a trace to numbers.

May import: agents, twins, experiments.definition, experiments.recording.
"""
