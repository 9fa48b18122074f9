"""DJI Tello through djitellopy: kind, protocol, body, one pilot per drone, protocol twin.

May import: agents, bridges.measured_flight, twins.
"""
