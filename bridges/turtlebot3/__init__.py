"""TurtleBot3 over Zenoh: kind, protocol, body, one robot with its topics, watchdog for it, protocol twin.

May import: agents, bridges.ros2, twins.
"""
