"""The command line and what it offers beyond running an experiment."""
