"""DJI Tello through djitellopy: the body, one pilot per drone.

May import: agents.
"""
