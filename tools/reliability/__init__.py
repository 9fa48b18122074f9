"""The fault laboratory and the soak: runs watched from outside."""
