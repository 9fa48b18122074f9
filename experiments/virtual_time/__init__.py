"""The virtual clock: simulation, its network and its log, as a trace or a recording."""
