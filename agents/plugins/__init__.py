"""Everything that an experiment file chooses by name: laws, triggers, predictors, planners, avoidances; their registry.

May import: agents.formation, agents.vectors, agents.errors.
"""
