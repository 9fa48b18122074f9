"""Protocol twins: simulated devices with the real wire protocol, to which the unmodified vendor library connects.

May import: agents, twins.arrays, twins.body, twins.models.
"""
