"""Robots: the pure decision of one robot, the process around it, and the network between them.

May import: agents.body, agents.decision, agents.network, agents.plugins, agents.safety.
"""
