"""Simulated bodies: models of one robot each, engines, sensors, disturbances, and protocol twins of devices.

May import: agents, twins.arrays, twins.models, twins.engines, twins.sensing.
"""
