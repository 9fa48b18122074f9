"""Wheels: arcs are arcs, limits keep the curve, and a command holds."""

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
    path, yaws = [], []
    for _ in range(round(seconds / DT)):
        twin.command((*twist, 0.0, 0.0))
        twin.move(DT)
        path.append(twin.position)
        yaws.append(twin.yaw)
    return np.array(path), np.array(yaws)


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.5), (0.2, 1e-9), (0.15, -1.5), (-0.1, 0.8)])
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
    np.testing.assert_allclose(path[:, :2], circle, atol=max(1e-6, abs(v / w) * (w * DT) ** 2 / 10))


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3], ids=lambda kind: kind.name)
def test_limit_of_wheels_keeps_the_curve(kind):
    limits, twin = kind.motion, robot(kind)
    speeds = np.diff(drive(twin, (kind.speed, 0.0), 1.0)[0][:, 0]) / DT
    assert np.diff(speeds).max() / DT == pytest.approx(limits.acceleration)
    assert speeds[-1] == pytest.approx(kind.speed)
    _, yaws = drive(twin, (3.0, 6.0), 2.0)
    speed, rate = np.linalg.norm(twin.velocity), (yaws[-1] - yaws[-2]) / DT
    assert speed / rate == pytest.approx(0.5, rel=1e-9)
    assert speed + 0.5 * limits.base * rate == pytest.approx(limits.speed)


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
