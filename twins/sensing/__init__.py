"""Range sensors of twins, and ray casting.

May import: agents, twins.arrays, twins.models, twins.scene, twins.engines.
"""
