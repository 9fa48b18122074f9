"""The picture of `check --plot`: where the target shape is laid."""

import numpy as np
import pytest

from experiments.check.check import analyses
from experiments.file import document
from experiments.report.trajectories import expected_motion

pytestmark = pytest.mark.slow  # flies on the virtual clock


def test_target_shape_is_laid_on_the_leader():
    given = document.read("robotic-park", ["timeline=[]", "duration_s=15"])
    known = analyses(given)["event"]
    axes = expected_motion({"event": known}).axes[0]
    target = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "D"]
    leader = known.names.index("TB01")
    assert target[leader] == pytest.approx(known.start[leader, :2], abs=1e-9)
    ends = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o" and line.get_markersize() == 3.5]
    assert np.array(ends) == pytest.approx(known.prediction.position[-1, :, :2])
    assert np.linalg.norm(np.array(target) - ends, axis=1).max() < 0.2
