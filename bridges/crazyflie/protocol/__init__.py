"""Wire of the Crazyflie: addresses and settings, CRTP packets, frames of its radio. No sockets here.

May import: agents.body, agents.vectors.
"""
