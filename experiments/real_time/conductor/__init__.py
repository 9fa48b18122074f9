"""`./zenpark run`: starts a case, walks its phases, changes robots, lands.

May import: agents, twins, experiments.definition, experiments.file, experiments.recording, experiments.scene,
experiments.real_time.hosts.
"""
