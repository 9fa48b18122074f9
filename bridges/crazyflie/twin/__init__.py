"""Protocol twin of the Crazyflie 2.x: CRTP over UDP, for an unmodified cflib.

May import: agents, bridges.crazyflie, twins.
"""
