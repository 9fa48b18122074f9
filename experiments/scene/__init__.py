"""Scene in three dimensions: what is drawn of a case at one moment, its meshes, tracks of a recording, and the drawing.

Imports experiments/recording and what lies below; only `drawing` needs viser. Live view, replay and report share it.
"""
