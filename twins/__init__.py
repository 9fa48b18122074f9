"""Simulated bodies: models of robots in rows, engines, sensors, disturbances, and protocol twins of devices.

May import: agents, twins.models, twins.engines, twins.sensing.
"""
