"""Conversion of experiment files of Robotic Park's authors."""
