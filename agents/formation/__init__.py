"""Formation graph and its theory: links, rigidity, anchors, changes of shape.

May import: agents.arrays.
"""
