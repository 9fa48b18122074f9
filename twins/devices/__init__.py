"""Protocol twins: simulated devices that speak the real wire protocol."""
