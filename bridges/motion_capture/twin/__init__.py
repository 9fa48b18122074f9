"""Protocol twins of motion capture: servers of the true poses, with faults, for any client.

May import: agents, bridges.motion_capture.cameras, bridges.motion_capture.protocol, twins.
"""
