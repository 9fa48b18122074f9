"""Levels of one tick, pure and row-wise: neighbours, goals, position control, transmission.

Imports body, plugins, formation.
"""
