"""The process around the decision: deadline loop, inboxes, telemetry, orders, lifeline, watchdog.

Nobody in agents imports it.
"""
