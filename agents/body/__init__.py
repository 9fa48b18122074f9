"""Bodies of robots: kinds, limits, and the interface between the decision and hardware or a twin.

May import: agents.network, agents.plugins, agents.user_folder, agents.vectors, agents.clock, agents.errors.
"""
