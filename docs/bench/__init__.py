"""zenpark beside other simulators, and with more robots: the programs behind `docs/results/peers.md`."""
