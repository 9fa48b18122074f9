"""From a trace to numbers. Imports recording, definition."""
