"""Crazyflie body through cflib, for real drones and protocol twins (cflib is GPL-3.0: imported when one is opened).

May import: agents.
"""
