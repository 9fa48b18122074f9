"""Plans from files: recorded poses and polynomial trajectories, and the planner that follows them.

May import: agents.errors, agents.plugins.planners, agents.plugins.registry, agents.vectors.
"""
