"""Motion capture: a reader for each system, and the process that publishes the poses that it reads.

May import: agents, bridges.motion_capture.protocol.
"""
