"""Positions by cameras with AprilTags: file of a lab, detection, fusion, calibration, images.

May import: agents, bridges.motion_capture, twins.arrays.
"""
