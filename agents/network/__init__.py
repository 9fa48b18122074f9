"""Zenoh: keys, messages, their validation, sessions, publishers and subscribers, access control, the modelled channel.

May import: agents.vectors, agents.clock, agents.errors.
"""
