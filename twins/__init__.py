"""Simulated bodies: models of one robot each, engines, sensors, disturbances, the base of protocol twins.

May import: agents, twins.arrays, twins.models, twins.engines, twins.sensing.
"""
