"""Motion of one robot: differential drives, quadrotors with on-board flight control, disturbances, noise.

May import: agents.
"""
