"""Robots: the pure, row-wise decision, the process around it, and the network between them."""
