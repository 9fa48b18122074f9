"""Range sensors of twins, and ray casting."""
