"""Cells of sweeps with given results."""

from experiments.metrics.metric import swept_metrics
from experiments.metrics.statistics import Spread
from experiments.sweep.table import CellRow, relative_metrics


def certain(mean):
    return Spread(mean, 0.0, 0.01, 9)


def cell(*, failed=0, environment=None, **ratios):
    """Cell of the case `event` with nine seeds; metrics that are not given are as in the reference."""
    place = environment or {}
    ratio = {index: certain(ratios.get(index, 1.0)) for index in {*relative_metrics(), *ratios}}
    mean = {index: certain(1.0) for index in swept_metrics()}
    return CellRow("event", place, place, {}, False, 9, failed, mean, ratio, 1.0, 0.02)
