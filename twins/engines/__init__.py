"""Physics engines behind one interface: point masses, pymunk (planar rigid bodies), MuJoCo (rigid quadrotors).

May import: agents, twins.arrays, twins.models, twins.scene.
"""
