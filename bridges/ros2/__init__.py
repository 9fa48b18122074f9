"""ROS 2 over rmw_zenoh and zenoh-bridge-ros2dds, without ROS here: messages, nodes, bridge of a realm.

May import: agents.
"""
