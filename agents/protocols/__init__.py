"""What hardware and its protocol twins say to each other: ports, words, packing, units. No sockets here."""
