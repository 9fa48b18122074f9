"""The process around the decision: deadline loop, inboxes, telemetry, orders, lifeline, watchdog.

May import: agents.
"""
