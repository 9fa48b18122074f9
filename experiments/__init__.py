"""The experiment: its file, its check, its two clocks, its recording and its report.

May import: agents, bridges, twins, experiments.definition, experiments.file, experiments.recording,
experiments.metrics, experiments.virtual_time, experiments.learning, experiments.report, experiments.check,
experiments.sweep, experiments.real_time.conductor.
"""
