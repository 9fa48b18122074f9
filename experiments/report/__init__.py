"""From numbers to tables, figures, HTML, CSV, MATLAB.

May import: agents, twins, experiments.definition, experiments.recording, experiments.metrics, experiments.scene,
experiments.check.
"""
