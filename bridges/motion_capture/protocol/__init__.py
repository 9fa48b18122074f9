"""Wires of motion capture: NatNet, QTM's RT protocol, Vicon's DataStream. No sockets here.

May import: agents.body.
"""
