"""Robots: the pure, row-wise decision, the process around it, and the network between them.

May import: agents.body, agents.decision, agents.network, agents.plugins, agents.safety.
"""
