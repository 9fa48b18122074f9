"""What a robot is made of: its kind and limits, and the one seam between the decision and hardware or a twin.

May import plugins, network keys, arrays.
"""
