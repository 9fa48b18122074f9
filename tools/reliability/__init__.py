"""The fault laboratory and the soak: runs watched from outside.

May import: agents, twins, bridges, experiments, tools.commands, tools.progress.
"""
