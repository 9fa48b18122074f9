"""What each started process runs: robot, recorder, world, centre, protocol twins."""
