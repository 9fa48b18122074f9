"""Can it work? Theory and an ideal run, as findings with remedies.

May import: agents, twins, experiments.catalogue, experiments.definition, experiments.file, experiments.recording,
experiments.metrics, experiments.virtual_time.
"""
