"""Commands, one file per subject: signatures and what they do. Imports everything below tools when a command runs."""
