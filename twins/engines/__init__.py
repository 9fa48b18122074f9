"""Physics engines behind one interface: point masses, pymunk (planar rigid bodies), MuJoCo (rigid quadrotors)."""
