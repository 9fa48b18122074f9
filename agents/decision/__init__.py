"""The levels of one tick, pure and row-wise: what is told and heard, goals, position control, when to transmit.

Imports body, plugins, formation.
"""
