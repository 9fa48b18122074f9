"""Noise that belongs to its robot, and disturbances with the statistics that they promise."""

import math
from itertools import product

import msgspec
import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from twins.models.disturbance import Drift, HoverJitter, Latency, Measurement
from twins.models.noise import BLOCK, Noise


def noise(rows, width, purpose="test", seed=1):
    return Noise([f"R{k}" for k in range(rows)], [seed] * rows, purpose, width)


def test_a_robot_s_noise_is_the_same_alone_and_in_a_swarm():
    names, seeds = ["CF01", "KH01", "CF02", "CF01"], [1, 1, 1, 2]
    swarm = Noise(names, seeds, "measurement", 3)
    together = np.array([swarm.draw() for _ in range(BLOCK + 10)])  # over the edge of a block
    for row, (name, seed) in enumerate(zip(names, seeds, strict=True)):
        alone = Noise([name], [seed], "measurement", 3)
        np.testing.assert_array_equal([alone.draw()[0] for _ in range(BLOCK + 10)], together[:, row])


def test_streams_of_other_robots_seeds_and_purposes_are_others():
    each = product(("A", "B"), (1, 2), ("jitter", "odometry"))
    streams = [Noise([name], [seed], purpose, 1) for name, seed, purpose in each]
    drawn = np.array([[stream.draw()[0, 0] for _ in range(2000)] for stream in streams])
    assert np.abs(np.corrcoef(drawn) - np.eye(8)).max() < 0.1


def test_it_is_white_with_unit_variance():
    source = noise(8, 4)
    drawn = np.array([source.draw() for _ in range(2000)])
    assert drawn.std() == pytest.approx(1.0, abs=0.01)
    assert abs(drawn.mean()) < 0.01
    assert abs((drawn[1:] * drawn[:-1]).mean()) < 0.01


@pytest.mark.parametrize("dt", [0.005, 0.01, 0.05])
def test_hover_jitter_has_its_sigma_and_its_correlation_time_whatever_the_step(dt):
    rows, sigma, tau = 64, 0.01, 0.5
    jitter = HoverJitter([Disturbance(hover_jitter=Jitter(sigma, tau))] * rows, noise(rows, 2), dt)
    assert jitter.present
    seen = [jitter.advance(np.ones(rows)) for _ in range(round(20.0 / dt))]
    settled = np.array(seen[round(3.0 / dt) :])
    assert settled.std() == pytest.approx(sigma, rel=0.04)
    for lag_s in (0.2, 0.5, 1.0):
        lag = round(lag_s / dt)
        correlation = (settled[lag:] * settled[:-lag]).mean() / sigma**2
        assert correlation == pytest.approx(math.exp(-lag_s / tau), abs=0.05)
    assert np.array(seen[0]).std() == pytest.approx(sigma * math.sqrt(2 * dt / tau), rel=0.2)  # it begins at rest


def test_rows_without_jitter_stand_still_beside_those_that_have_it():
    jitter = HoverJitter([Disturbance(), Disturbance(hover_jitter=Jitter(0.02))], noise(2, 2), 0.01)
    for _ in range(50):
        displacement = jitter.advance(np.ones(2))
    assert not displacement[0].any()
    assert displacement[1].all()
    assert not HoverJitter([Disturbance()], noise(1, 2), 0.01).present


def test_measurement_noise_has_its_sigmas_on_the_axes_that_are_measured():
    nature = [Disturbance(position_sigma=0.003, yaw_sigma=0.02), Disturbance(position_sigma=0.001), Disturbance()]
    axes = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    measurement = Measurement(nature, axes, noise(3, 4))
    drawn = np.array([measurement.draw() for _ in range(5000)])
    expected = [[0.003, 0.003, 0.003, 0.02], [0.001, 0.001, 0.0, 0.0], [0.0] * 4]
    np.testing.assert_allclose(drawn.std(axis=0), expected, rtol=0.04)
    assert not Measurement([Disturbance()], axes[:1], noise(1, 4)).present


def test_the_variance_of_odometry_grows_with_the_way():
    rows, rate = 300, 0.02
    drift = Drift([Disturbance(odometry_drift=rate)] * rows, noise(rows, 2))
    step = np.tile([0.006, 0.008], (rows, 1))  # a centimetre
    for ticks in (100, 300):
        for _ in range(ticks):
            drift.advance(step)
        way = 0.01 * (100 if ticks == 100 else 400)
        assert drift.error.var() == pytest.approx(rate**2 * way, rel=0.12)
    before = drift.error.copy()
    drift.advance(np.zeros((rows, 2)))
    np.testing.assert_array_equal(drift.error, before)  # who stands does not drift


def test_latency_is_exact_in_ticks_row_by_row():
    latency = Latency([Disturbance(), Disturbance(latency_s=0.01), Disturbance(latency_s=0.03)], 0.01)
    assert latency.present
    got = [latency.delay(np.full((3, 4), float(k)))[:, 0] for k in range(8)]
    np.testing.assert_array_equal(np.array(got)[:, 0], range(8))
    np.testing.assert_array_equal(np.array(got)[:, 1], [np.nan, *range(7)])
    np.testing.assert_array_equal(np.array(got)[:, 2], [np.nan] * 3 + list(range(5)))
    assert not Latency([Disturbance()], 0.01).present


@pytest.mark.parametrize(("sigma", "correlation_s"), [(-0.1, 0.5), (1.0, 0.5), (0.01, 0.0)])
def test_jitter_that_makes_no_sense(sigma, correlation_s):
    with pytest.raises(msgspec.ValidationError, match="Expected `float`"):
        msgspec.convert({"sigma": sigma, "correlation_s": correlation_s}, Jitter)
