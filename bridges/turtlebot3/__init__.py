"""TurtleBot3 over Zenoh (zenoh-bridge-ros2dds or rmw_zenoh): the body, and one robot with its topics.

May import: agents.
"""
