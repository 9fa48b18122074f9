"""Khepera IV over TCP: the body, one link per robot, odometry."""
