"""The MCAP file, written and read back, and the trace: one case as arrays."""
