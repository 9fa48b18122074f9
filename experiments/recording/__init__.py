"""The MCAP file, written and read back, and the trace: one case as arrays.

May import: agents, twins, experiments.arrays, experiments.definition, experiments.file, experiments.recording.ros2.
"""
