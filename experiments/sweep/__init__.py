"""Cases x values x seeds on all cores or a cluster, and the search for parameters."""
