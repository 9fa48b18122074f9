"""Sources of experiment files: generated formations, and the files of Robotic Park."""
