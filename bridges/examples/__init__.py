"""Programs to start from: other simulators as bodies of robots."""
