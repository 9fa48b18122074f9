"""Setpoint filter, hazards and their detection, preflight, landing: all that overrules a decision.

May import: agents.decision, agents.body, agents.plugins, agents.ticks, agents.vectors.
"""
