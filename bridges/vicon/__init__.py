"""Vicon motion capture: a DataStream client, and the process that publishes poses.

May import: agents.
"""
