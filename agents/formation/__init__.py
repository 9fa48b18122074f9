"""Knowledge of a robot about its formation: targets of links, anchors, changes of shape.

May import: agents.ticks, agents.vectors.
"""
