"""Starting processes here and, over ssh, on other machines; their clocks and certificates; the runs of this machine.

May import: agents, twins, bridges, experiments.definition, experiments.recording,
experiments.real_time.processes.zygote.
"""
