"""A script for each simulator, run by that simulator's own interpreter: `ring` and numpy are all that they share."""
