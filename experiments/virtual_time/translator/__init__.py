"""From functions in Python to text in C: types and values, expressions, calls, statements.

May import: agents.decision.neighbours, agents.decision.stepping, agents.plugins.law, agents.vectors,
experiments.virtual_time.records.
"""
