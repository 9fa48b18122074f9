"""Laws of the literature, each with the theorem that its test shows; written as plug-ins of a user are.

May import: nothing.
"""
