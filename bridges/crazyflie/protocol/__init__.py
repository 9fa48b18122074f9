"""Wire of the Crazyflie: addresses and settings, CRTP packets, parameters, frames of its radio. No sockets here.

May import: agents.body, agents.errors, agents.vectors.
"""
