"""What overrules a decision: the setpoint filter, hazards and their detection, preflight, landing. Imports decision."""
