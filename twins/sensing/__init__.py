"""Range sensors: which there are, and ray casting."""
