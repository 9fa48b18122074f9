"""What a robot knows of its formation: targets of links, anchors, changes of shape.

May import: agents.vectors.
"""
