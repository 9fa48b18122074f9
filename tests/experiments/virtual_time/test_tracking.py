"""Tracking of a target, against a central Kalman filter with the same readings."""

import numpy as np
import pytest
from scipy.special import gammaincinv

from experiments.catalogue import index
from experiments.file import document
from tests.runs import flown, fly


def track_centrally(known, steps, seeing):
    """Estimates (K, 4) of one Kalman filter that has all readings of a run at once."""
    law, step = known.plan.experiment.formation.law, 0.1
    onward, per_axis = np.eye(4) + step * np.eye(4, k=2), [[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]]
    growth = law["agility"] * np.kron(per_axis, np.eye(2))
    x, covariance = np.array([*law["guess"], 0.0, 0.0]), np.diag(np.repeat(law["doubt"], 2)) ** 2
    states = []
    for moment in steps:
        x, covariance = onward @ x, onward @ covariance @ onward.T + growth
        information = np.linalg.inv(covariance)
        vector, (east, north) = information @ x, (x[:2] - known.true_position[moment, seeing, :2]).T
        far = np.hypot(east, north)
        expected, slopes = far, np.stack([east, north]) / far
        if law["sees"] == "direction":
            expected, slopes = np.arctan2(north, east), np.stack([-north, east]) / far**2
        change = known.measures["reading"][moment, seeing] - expected
        if law["sees"] == "direction":
            change = (change + np.pi) % (2.0 * np.pi) - np.pi
        for each, slope in zip(change[~np.isnan(change)], slopes.T[~np.isnan(change)], strict=True):
            information = information + np.outer([*slope, 0, 0], [*slope, 0, 0]) / law["sigma"] ** 2
            vector = vector + np.array([*slope, 0, 0]) * (each + slope @ x[:2]) / law["sigma"] ** 2
        covariance = np.linalg.inv(information)
        x = covariance @ vector
        states.append(x)
    return np.array(states)


def track(case, seed, *changes):
    """Mean squared errors of a place [m²], of the robots and of a central filter, and normalised ones of the robots."""
    run = flown("tracking", case, *changes, seed=seed)
    plan, known = run.plan, run.trace
    seeing, steps = slice(1, None), np.arange(5, len(known.time), 5)
    place = known.true_position[:, 0, :2]
    truth = np.hstack([place, np.gradient(place, known.time, axis=0)])[steps]
    states = track_centrally(known, steps, seeing)
    late = known.time[steps] > 5.0
    apart = (known.memory["x"][steps][:, seeing] - truth[:, None])[late]
    information = known.memory["all"][steps][:, seeing].reshape(len(steps), -1, 4, 4)[late]
    normalised = np.einsum("tni,tnij,tnj->tn", apart, information / plan.experiment.formation.law["sigma"] ** 2, apart)
    squares = (apart[..., :2] ** 2).sum(axis=2).mean(), ((states - truth)[late, :2] ** 2).sum(axis=1).mean()
    return *squares, normalised.mean(axis=1)[::20]  # every two seconds, since errors last that long


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "most"), [("periodic", 1.1), pytest.param("event", 1.15, marks=pytest.mark.nightly), ("event-loss", 1.15)]
)
def test_tracking_is_consistent_and_as_accurate_as_central(case, most):
    runs = [track(case, seed) for seed in (1, 2)]
    own, central = (sum(run[k] for run in runs) / len(runs) for k in (0, 1))
    assert central < own < most**2 * central
    assert own < 0.05**2
    normalised = np.concatenate([run[2] for run in runs])
    low, high = 2.0 * gammaincinv(2.0 * len(normalised), [0.005, 0.995]) / len(normalised)  # of χ² with 4 each
    assert low < normalised.mean() < high


@pytest.mark.slow
def test_tracking_by_directions():
    own, central, _ = track("periodic", 1, "formation.law.sees=direction", "formation.law.sigma=0.08")
    assert own < 1.1**2 * central
    assert own < 0.06**2


def without_lines(*begins):
    """Text of the file without lines that begin so."""
    text = index.find_file("tracking").read_text("utf-8")
    return "\n".join(line for line in text.splitlines() if not line.startswith(begins))


@pytest.mark.slow
def test_robots_without_sight_know_target_from_others():
    bare = document.loads(without_lines('"TB01 > KH01"', '"TB01 > KH04"'))
    known = fly(bare.cases()["event"].experiment).trace
    late = known.time > 5.0
    assert np.isnan(known.measures["reading"][late][:, [1, 4]]).all()
    apart = known.memory["x"][late][:, 1:, :2] - known.true_position[late, :1, :2]
    assert np.sqrt((apart**2).sum(axis=2).mean(axis=0)).max() < 0.06


@pytest.mark.parametrize(
    ("target", "unseen", "faults"),
    [("KH99", "-", ["the target 'KH99' is no robot of the experiment"]), ("KH02", "-", []),
     ("TB01", "TB01 > ", ["no robot sees TB01"])],
)  # fmt: skip
def test_a_target_is_a_robot_that_others_see(target, unseen, faults):
    plan = document.loads(without_lines(f'"{unseen}'), f"formation.law.target={target}").plan
    assert [each[:2] for each in plan.law.analyse(plan)] == [("error", fault) for fault in faults]
