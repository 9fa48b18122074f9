"""Zenoh: keys, messages, their validation, sessions, publishers and subscribers, access control, the modelled channel.
Imports arrays only.
"""
