"""Everything that an experiment file chooses by name: laws, triggers, predictors, planners, avoidances; their registry.

May import: agents.errors, agents.formation, agents.ticks, agents.user_folder, agents.vectors.
"""
