"""Processes of a run: robot, recorder, world, central controller, protocol twins."""
