"""Levels of one tick, pure and row-wise: neighbours, goals, position control, transmission.

May import: agents.body, agents.network, agents.plugins, agents.formation, agents.arrays.
"""
