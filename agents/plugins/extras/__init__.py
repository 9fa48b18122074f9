"""Laws with libraries that are extras of zenpark, imported at first use.

May import: nothing.
"""
