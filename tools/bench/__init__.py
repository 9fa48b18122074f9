"""Speed, measured beside a baseline.

May import: agents, twins, experiments, tools.commands, tools.reliability.
"""
