"""Devices, a folder each: kind, protocol, body and protocol twin of a robot; positioning, ROS 2, external simulators.

May import: agents.
"""
