"""Moments of a scene without a run."""

from __future__ import annotations

from math import inf

import numpy as np

from experiments.scene.stage import Condition, Moment, SceneModel


def unknown(stage: SceneModel) -> Moment:
    """Nothing is known yet."""
    rows, net = len(stage.names), len(stage.links)
    blank = np.full((rows, 3), np.nan)
    return Moment(
        blank, np.full(rows, np.nan), blank.copy(), np.full(rows, int(Condition.WAITING)), np.full(rows, inf),
        np.full(net, np.nan), np.zeros(net, dtype=bool), stage.scene.pose.copy(), np.zeros((rows, 0, 3)),
    )  # fmt: skip
