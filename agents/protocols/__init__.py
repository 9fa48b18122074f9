"""Protocols between hardware, or its protocol twins, and bridges: ports, words, packing, units. No sockets here.

May import: agents.body, agents.network, agents.vectors, agents.clock.
"""
