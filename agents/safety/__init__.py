"""Setpoint filter, hazards and their detection, preflight, landing: all that overrules a decision. Imports decision."""
