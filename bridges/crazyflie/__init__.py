"""Crazyflie: kind, and body through cflib for drones and protocol twins (cflib is GPL-3.0: imported when opened).

May import: agents, bridges.crazyflie.protocol, bridges.measured_flight.
"""
