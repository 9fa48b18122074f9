"""Khepera IV over TCP or a serial line: the body, one link per robot, odometry.

May import: agents.
"""
