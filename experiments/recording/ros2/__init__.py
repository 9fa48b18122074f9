"""Messages of a recording as ROS 2 messages: our own structs, and the standard types that viewers draw.

May import: agents.
"""
