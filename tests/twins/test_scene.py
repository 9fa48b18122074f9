"""Distances from obstacles, against a search over points of their outlines; where they are over time."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.plugins.planners import Circle, Line
from twins import scene as outlines
from twins.scene import Obstacle, Scene

BOX = Obstacle(box=(0.4, 0.2), at=(1.0, 0.5), yaw=0.5)
POST = Obstacle(radius=0.2, at=(-0.5, 0.3))
FENCE = Obstacle(wall=[(0.5, 0.8), (0.5, 0.0), (0.0, 0.0)], at=(0.2, -0.7), yaw=-0.4)
metres = st.floats(-2.0, 2.0)


def scene(*given, plans=None, size=(4.0, 4.0, 2.0)):
    names = [f"o{k}" for k in range(len(given))]
    return Scene.furnished(size, dict(zip(names, given, strict=True)), plans or {}, walled=True)


def sampled(obstacle, count=4000):
    """Points of an outline, as dense as that."""
    if obstacle.radius is not None:
        angle = np.linspace(0.0, 2.0 * math.pi, count)
        return obstacle.at + obstacle.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = scene(obstacle).outline[0]
    ends = np.vstack([corners, corners[:1]]) if obstacle.box else corners
    share = np.linspace(0.0, 1.0, count)[:, None]
    points = np.concatenate([a + share * (b - a) for a, b in pairwise(ends)])
    cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
    return points @ np.array([[cos, sin], [-sin, cos]]) + obstacle.at


@given(metres, metres, st.sampled_from([BOX, POST, FENCE]))
def test_distance_is_to_the_nearest_point(x, y, obstacle):
    there = scene(obstacle)
    found = float(outlines.distance(there, 0, there.pose[0], np.array([x, y])))
    nearest = float(np.hypot(*(sampled(obstacle) - [x, y]).T).min())
    assert abs(found) == pytest.approx(nearest, abs=2e-4)


def test_distances_of_many_points_are_negative_inside():
    there = scene(BOX, POST, FENCE)
    found = [float(outlines.distance(there, k, there.pose[k], there.pose[k, :2])) for k in range(3)]
    assert found == pytest.approx([-0.1, -0.2, 0.0])
    pose = np.zeros((5, 1, 3))
    pose[:, 0, 0] = np.arange(5.0)
    point = np.zeros((5, 2, 2))
    point[:, 1, 1] = 1.0
    found = outlines.distance(there, 0, pose, point)
    assert found.shape == (5, 2)
    assert found[:, 0] == pytest.approx([-0.1, 0.8, 1.8, 2.8, 3.8])
    assert found[0, 1] == pytest.approx(0.9)


def test_planned_poses_over_time():
    plans = {"o0": Line(move_by=[1.0, 0.5], speed_=0.2), "o1": Circle(radius=0.5, period_s=10.0)}
    there = scene(BOX, POST, FENCE, plans=plans)
    time = np.linspace(-1.0, 20.0, 43)
    path = there.along(time)
    assert path == pytest.approx(np.array([there.at(t) for t in time]))
    assert path[time <= 0.0, 0] == pytest.approx(np.tile(there.pose[0], (3, 1)))
    assert path[-1, 0] == pytest.approx([2.0, 1.0, 0.5])
    assert path[-1, 1:] == pytest.approx(there.pose[1:])  # back after two turns
    assert there.poses(20.0) == [tuple(pose) for pose in there.at(20.0).tolist()]


def test_heights_overlap_between_bottom_and_top():
    there = scene(Obstacle(radius=0.1, bottom=1.0, height=0.5), Obstacle(radius=0.1))
    assert [bool(outlines.at_height(there, 0, low, low + 0.2)) for low in (0.7, 0.9, 1.4, 1.6)] == [
        False, True, True, False
    ]  # fmt: skip
    assert bool(outlines.at_height(there, 1, 1.8, 1.9))  # up to the ceiling


@pytest.mark.parametrize(
    ("obstacle", "out"),
    [
        (Obstacle(radius=0.5, at=(2.3, 0.0)), False),
        (Obstacle(radius=0.5, at=(2.6, 0.0)), True),
        (Obstacle(radius=0.5, at=(2.4, 2.4)), True),  # nearer than its radius along both axes, but not to the corner
        (Obstacle(box=(1.0, 1.0), at=(2.4, 0.0)), False),
        (Obstacle(box=(1.0, 1.0), at=(2.6, 0.0)), True),
        (Obstacle(box=(1.0, 1.0), at=(2.6, 0.0), yaw=math.pi / 4.0), False),
        (Obstacle(box=(1.0, 1.0), at=(2.45, 2.45), yaw=math.pi / 4.0), True),  # its side faces the corner
        (Obstacle(wall=[(-3.0, 0.0), (3.0, 0.0)]), False),
        (Obstacle(wall=[(3.0, 0.0), (0.0, 3.0)]), False),
        (Obstacle(wall=[(4.5, 0.0), (0.0, 4.5)]), True),  # cuts the corner off, outside
        (Obstacle(wall=[(2.0, -1.0), (2.0, 1.0)]), False),  # on the border
    ],
)
def test_obstacles_outside_the_arena(obstacle, out):
    assert outlines.outside(scene(obstacle), 0) is out
