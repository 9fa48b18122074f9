"""Starting processes here and, over ssh, on other machines; their clocks and certificates."""
