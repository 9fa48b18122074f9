"""The real clock: conductor, hosts, and the processes that they start.

May import: nothing.
"""
