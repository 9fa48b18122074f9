"""Bodies of robots: kinds, limits, and the interface between the decision and hardware or a twin.

May import plugins, network keys, arrays.
"""
