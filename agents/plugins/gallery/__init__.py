"""Laws of the literature, each with the theorem that its test shows.

May import: agents.plugins, agents.vectors.
"""
