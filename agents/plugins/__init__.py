"""Everything an experiment file chooses by name: laws, triggers, predictors, planners, avoidances, and their registry.
Imports formation, arrays.
"""
