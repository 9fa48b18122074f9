"""Wheels: arcs are arcs, limits keep the curve, and a command holds."""

import math

import numpy as np
import pytest

from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.vectors import ZERO
from twins.models.differential import Differential

DT = 0.01


def robot(kind=KHEPERA4, yaw=0.0):
    return Differential(kind, ZERO, yaw)


def drive(twin, twist, seconds):
    """(T, 3) positions and (T,) yaws."""
    path, yaws = [], []
    for _ in range(round(seconds / DT)):
        twin.command((*twist, 0.0, 0.0))
        twin.move(DT)
        path.append(twin.position)
        yaws.append(twin.yaw)
    return np.array(path), np.array(yaws)


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.5), (0.15, -1.5), (-0.1, 0.8)])
def test_constant_twist_is_a_circle(v, w):
    twin = robot(yaw=0.4)
    drive(twin, (v, w), 0.5)  # up to speed
    begin, heading = twin.position, twin.yaw
    path, yaws = drive(twin, (v, w), 3.0)
    t = DT * np.arange(1, 301)
    np.testing.assert_allclose(yaws, heading + w * t, atol=1e-12)
    angle = heading + w * t
    circle = begin[:2] + v / w * np.stack([np.sin(angle) - np.sin(heading), np.cos(heading) - np.cos(angle)], axis=1)
    # chords of the length of the arc: longer than the circle's by (w dt)²/24
    np.testing.assert_allclose(path[:, :2], circle, atol=abs(v / w) * (w * DT) ** 2 / 10)
    assert not path[:, 2].any()


def test_straight_on_and_on_the_spot():
    twin = robot(yaw=math.pi / 3)
    drive(twin, (0.2, 0.0), 1.0)
    way = np.linalg.norm(twin.position)
    np.testing.assert_allclose(twin.position, way * np.array([0.5, math.sqrt(0.75), 0.0]), atol=1e-12)
    ramp = 0.2**2 / (2 * KHEPERA4.motion.acceleration)
    assert way == pytest.approx(0.2 - ramp, abs=0.002)
    drive(twin, (0.0, 0.0), 0.2)
    place = twin.position
    drive(twin, (0.0, 1.0), 1.0)
    np.testing.assert_allclose(twin.position, place, atol=1e-12)


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3], ids=lambda kind: kind.name)
def test_limit_of_wheels_keeps_the_curve(kind):
    limits, twin = kind.motion, robot(kind)
    drive(twin, (kind.speed, 0.0), 1.0)
    assert np.linalg.norm(twin.velocity) == pytest.approx(kind.speed)
    v, w = 3.0, 6.0
    drive(twin, (v, w), 2.0)
    speed = np.linalg.norm(twin.velocity)
    before = twin.yaw
    twin.move(DT)
    rate = (twin.yaw - before) / DT
    assert speed / rate == pytest.approx(v / w, rel=1e-9)
    assert speed + 0.5 * limits.base * rate == pytest.approx(limits.speed)


def test_acceleration_of_wheels_is_limited():
    twin = robot(TURTLEBOT3)
    path, _ = drive(twin, (0.2, 0.0), 0.3)
    speed = np.diff(path[:, 0], prepend=0.0) / DT
    steps = np.diff(speed, prepend=0.0) / DT
    assert steps.max() == pytest.approx(2.0)
    assert speed[-1] == pytest.approx(0.2)


def test_command_holds_until_next_or_landing():
    twin = robot()
    drive(twin, (0.2, 0.0), 0.5)
    for _ in range(1000):
        twin.move(DT)
    for no_command in ((np.nan, np.nan), (np.nan, 0.0), (0.0, np.nan)):
        drive(twin, no_command, 0.5)
        assert np.linalg.norm(twin.velocity) == pytest.approx(0.2)
    assert np.isfinite(twin.position).all()
    twin.land()
    for _ in range(20):
        twin.move(DT)
    assert twin.velocity == ZERO
