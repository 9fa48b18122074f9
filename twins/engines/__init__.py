"""What moves a world: point masses, pymunk, MuJoCo. One small interface."""
