"""From text to a definition: reading, overrides, cases, and every error with file:line:column.

May import: agents, twins, experiments.definition, experiments.catalogue, experiments.file.consistency,
experiments.file.graphs.
"""
