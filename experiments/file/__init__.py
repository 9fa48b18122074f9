"""From text to a definition: reading, overrides, cases, and every error with file:line:column. Imports definition."""
