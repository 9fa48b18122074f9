"""Scene in three dimensions: what is drawn of a case at one moment, as arrays; its meshes; and its drawing with viser.

Imports experiments/definition and what lies below; only `drawing` needs viser. Live view, replay and report share it.
"""
