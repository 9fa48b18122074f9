"""`./zenpark run`: starts a case, walks its phases, changes robots, lands."""
