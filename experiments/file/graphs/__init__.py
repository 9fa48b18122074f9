"""Links of a formation from a file with a graph: GraphML, an edge list or an adjacency matrix.

May import: agents.errors, agents.plugins, experiments.definition, experiments.file.completion,
experiments.file.problems.
"""
