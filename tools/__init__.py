"""The command line and what it offers beyond running an experiment.

May import: agents, twins, bridges, experiments, tools.commands.
"""
