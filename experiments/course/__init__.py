"""A course: exercises made from solved files, and what groups hand in, marked in processes with limits.

May import: agents, experiments.cores, experiments.file, experiments.check, experiments.metrics, experiments.report,
experiments.run.
"""
