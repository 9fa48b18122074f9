"""A course: exercises made from solved files, and what groups hand in, marked by code of the course alone.

May import: agents, experiments.cores, experiments.file, experiments.check, experiments.metrics, experiments.report,
experiments.run.
"""
