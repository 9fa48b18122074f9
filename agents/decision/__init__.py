"""Levels of one tick of one robot, pure: neighbours, goals, position control, transmission.

May import: agents.body, agents.network, agents.plugins, agents.formation, agents.ticks, agents.vectors.
"""
