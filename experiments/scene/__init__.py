"""Scene in three dimensions: what is drawn of a case at one moment, its meshes, and the drawing.

Only `drawing` needs viser. Live view, replay and report share the scene.
May import: agents, twins, experiments.arrays, experiments.definition, experiments.recording, experiments.metrics.
"""
