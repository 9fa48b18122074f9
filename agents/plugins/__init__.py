"""Everything that an experiment file chooses by name: laws, triggers, predictors, planners, avoidances; their registry.

Imports formation and arrays.
"""
