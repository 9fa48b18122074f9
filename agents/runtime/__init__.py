"""The process around the decision: deadline loop, descent, inboxes, telemetry, orders, lifeline, watchdog.

May import: agents.
"""
