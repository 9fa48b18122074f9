"""Physics engines behind one interface: point masses, pymunk (planar rigid bodies).

May import: agents, twins.arrays, twins.models, twins.scene.
"""
