"""How robots move: rows of differential and flying robots, disturbances, noise."""
