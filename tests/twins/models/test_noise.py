"""Noise of a robot, and the statistics of its disturbances."""

import math
import zlib

import msgspec
import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from agents.vectors import NO_SETPOINT
from twins.models.disturbance import HoverJitter, Latency, MeasurementNoise, OdometryDrift
from twins.models.noise import BLOCK, Noise, refill


def numbers(noise, draws):
    width, drawn = noise.end // BLOCK, []
    for _ in range(draws):
        drawn.append(noise.ahead[noise.next : noise.next + width])
        noise.next += width
        refill(noise)
    return np.array(drawn)


def test_stream_is_that_of_numpy():
    source = np.random.default_rng([7, zlib.crc32(b"CF01"), zlib.crc32(b"measurement")])
    expected = source.standard_normal((200, 4)) * [0.1, 0.1, 0.0, 0.3]
    asked = ("CF01", 7, "measurement", (0.1, 0.1, 0.0, 0.3))
    np.testing.assert_array_equal(numbers(Noise(*asked), 200), expected)
    np.testing.assert_array_equal(Noise(*asked, block=200).ahead, expected.ravel())
    for wrong in ({"sigma": -0.1}, {"sigma": 1.0}, {"sigma": 0.01, "correlation_s": 0.0}):
        with pytest.raises(msgspec.ValidationError, match="Expected `float`"):
            msgspec.convert(wrong, Jitter)


def jittered(dt, seed, ticks, height=1.0):
    jitter = HoverJitter(Disturbance(hover_jitter=Jitter(0.01, 0.5)), "A", seed, dt)
    seen = []
    for _ in range(ticks):
        seen.append(jitter.advance(height))
        refill(jitter.noise)
    return np.array(seen)


@pytest.mark.parametrize("dt", [0.005, 0.01, 0.05])
def test_hover_jitter_has_sigma_and_correlation_time(dt):
    sigma, tau = 0.01, 0.5
    seen = np.stack([jittered(dt, seed, round(20.0 / dt)) for seed in range(64)], axis=1)
    settled = seen[round(3.0 / dt) :]
    assert settled.std() == pytest.approx(sigma, rel=0.04)
    for lag_s in (0.2, 0.5, 1.0):
        lag = round(lag_s / dt)
        correlation = (settled[lag:] * settled[:-lag]).mean() / sigma**2
        assert correlation == pytest.approx(math.exp(-lag_s / tau), abs=0.05)
    assert seen[0].std() == pytest.approx(sigma * math.sqrt(2 * dt / tau), rel=0.2)  # it begins at rest
    full, low, landed = (jittered(0.01, 1, 20, height) for height in (1.0, 0.1, 0.0))
    np.testing.assert_allclose([low, landed], [0.5 * full, 0.0 * full], rtol=1e-12)
    assert not (jittered(0.01, 2, 20) == full).any()


def test_no_disturbance_needs_no_noise():
    none = Disturbance()
    assert not Latency(none, 0.01).present
    measurement = MeasurementNoise(none, "A", 1, spatial=True)
    for disturbed in (HoverJitter(none, "A", 1, 0.01), OdometryDrift(none, "A", 1), measurement):
        refill(disturbed.noise)
        assert (disturbed.present, len(disturbed.noise.ahead)) == (False, 0)


def test_measurement_noise_has_sigma_on_measured_axes():
    for disturbance, spatial, sigma in (
        (Disturbance(position_sigma=0.003, yaw_sigma=0.02), True, [0.003, 0.003, 0.003, 0.02]),
        (Disturbance(position_sigma=0.001), False, [0.001, 0.001, 0.0, 0.0]),
    ):
        measurement, drawn = MeasurementNoise(disturbance, "A", 1, spatial=spatial), []
        for _ in range(5000):
            drawn.append(measurement.draw())
            refill(measurement.noise)
        np.testing.assert_allclose(np.std(drawn, axis=0), sigma, rtol=0.04)


def test_variance_of_odometry_grows_with_way():
    rate, errors = 0.02, {100: [], 400: []}
    for seed in range(300):
        drift = OdometryDrift(Disturbance(odometry_drift=rate), "A", seed)
        for tick in range(1, 401):
            drift.advance(0.006, 0.008)  # a centimetre
            refill(drift.noise)
            if tick in errors:
                errors[tick] += [drift.x, drift.y]
    for ticks, error in errors.items():
        assert np.var(error) == pytest.approx(rate**2 * 0.01 * ticks, rel=0.12)
    before = drift.x, drift.y
    drift.advance(0.0, 0.0)
    assert (drift.x, drift.y) == before  # who stands does not drift


def test_latency_is_exact_in_ticks():
    commands = [(float(k), 0.0, 0.0, 0.0) for k in range(8)]
    for ticks in (0, 1, 3):
        latency = Latency(Disturbance(latency_s=0.01 * ticks), 0.01)
        assert latency.present == (ticks > 0)
        assert [latency.delay(command) for command in commands] == [NO_SETPOINT] * ticks + commands[: 8 - ticks]
