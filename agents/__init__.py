"""What one robot decides and says: the pure, row-wise decision, and the process around it."""
