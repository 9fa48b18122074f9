"""The experiment files that come with zenpark, and where they lie.

May import: nothing.
"""
