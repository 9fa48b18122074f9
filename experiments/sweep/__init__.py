"""Cases x values x seeds on all cores or a cluster, and the search for parameters.

May import: agents, twins, experiments.definition, experiments.file, experiments.recording, experiments.metrics,
experiments.virtual_time, experiments.report, experiments.cores.
"""
