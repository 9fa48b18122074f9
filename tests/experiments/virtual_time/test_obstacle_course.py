"""The obstacle course of the catalogue: through a gap narrower than the formation, and back in shape."""

import numpy as np
import pytest

from agents.body.kinds import KINDS
from experiments.file.document import read
from experiments.virtual_time import simulation
from tests.experiments.traces import link_errors
from twins import scene as outlines
from twins.arrays import norm

RADIUS = KINDS["turtlebot3"].radius


def test_the_gap_is_narrower_than_the_formation():
    experiment = read("obstacle-course").experiment
    left, right = (experiment.arena.obstacles[name] for name in ("left", "right"))
    gap = left.at[1] - right.at[1] - 0.5 * (left.box[1] + right.box[1])
    wide = np.ptp([robot.start[1] for robot in experiment.robots.values()]) + 2.0 * RADIUS
    assert gap == pytest.approx(0.6)
    assert wide == pytest.approx(1.01)


@pytest.mark.slow
@pytest.mark.parametrize("case", [pytest.param("periodic", marks=pytest.mark.nightly), "event"])
def test_it_passes_without_contact_and_recovers(case):
    plan = read("obstacle-course").cases()[case]
    experiment = plan.experiment
    log = simulation.simulate(plan, experiment.seed)
    run = (log.time >= 0.0) & (log.time <= experiment.duration_s)
    time, place = log.time[run], log.true_position[run]
    scene = plan.scene
    assert log.touches == ()
    for k in range(len(scene.names)):
        assert (outlines.distance(scene, k, scene.pose[k], place[..., :2]) > RADIUS + 0.04).all()
    i, j = np.triu_indices(place.shape[1], 1)
    assert (norm(place[:, i, :2] - place[:, j, :2]) > 2.0 * RADIUS + 0.04).all()
    assert (place[-1, :, 0] > 0.5).all()  # all are through
    error = link_errors(plan.links, place).max(axis=1)
    assert error.max() > 0.3  # it had to fold
    assert error[time > 75.0].max() < 0.025
