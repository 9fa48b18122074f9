"""Bodies of real robots, positioning systems, ROS 2 and external simulators: one folder or file per device.

May import: agents.
"""
