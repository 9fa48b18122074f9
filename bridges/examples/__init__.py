"""Templates: external simulators as bodies of robots."""
