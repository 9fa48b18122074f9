"""Can it work? Theory and an ideal run, as findings with remedies. Imports file, definition."""
