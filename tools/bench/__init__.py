"""Speed, measured beside a baseline."""
