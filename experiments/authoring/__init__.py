"""Where experiment files come from: generated formations, and the files of Robotic Park."""
