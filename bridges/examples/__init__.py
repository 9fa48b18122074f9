"""Templates: external simulators as bodies of robots.

May import: nothing.
"""
