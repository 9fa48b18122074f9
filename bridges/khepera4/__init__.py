"""Khepera IV over TCP or a serial line: kind, protocol, body, one link per robot, odometry, protocol twin.

May import: agents, bridges.measured_flight, twins.
"""
