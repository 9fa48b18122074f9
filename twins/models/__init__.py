"""Motion models in rows: differential and flying robots, on-board flight control, disturbances, noise.

May import: agents.
"""
