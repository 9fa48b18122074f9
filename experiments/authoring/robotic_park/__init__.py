"""Converts Robotic Park's YAML."""
