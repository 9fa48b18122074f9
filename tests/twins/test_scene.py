"""Distances from obstacles, and where obstacles are over time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.plugins.planners import Circle, Line
from twins import scene as outlines
from twins.scene import Obstacle, Scene

BOX = Obstacle(box=(0.4, 0.2), at=(1.0, 0.5), yaw=0.5 * math.pi)
POST = Obstacle(radius=0.2, at=(-0.5, 0.3))
FENCE = Obstacle(wall=[(0.5, 0.8), (0.5, 0.0), (0.0, 0.0)], at=(0.2, -0.7), yaw=-0.5 * math.pi)


def scene(*given, plans=None, size=(4.0, 4.0, 2.0)):
    names = [f"o{k}" for k in range(len(given))]
    return Scene.furnished(size, dict(zip(names, given, strict=True)), plans or {}, walled=True)


def test_distances_of_many_points_are_negative_inside():
    there = scene(BOX, POST, FENCE)
    for k, points, distances in (
        (0, [(1.0, 0.5), (1.08, 0.4), (1.4, 0.5), (1.4, 1.1), (1.0, 0.2)], [-0.1, -0.02, 0.3, 0.5, 0.1]),
        (1, [(-0.5, 0.3), (0.0, 0.3)], [-0.2, 0.3]),
        (2, [(0.2, -0.7), (0.6, -1.0), (1.3, -1.6), (0.2, -0.3), (-0.1, -1.0)], [0.0, 0.2, 0.5, 0.4, 0.3]),
    ):
        found = [float(outlines.distance(there, k, there.pose[k], np.array(point))) for point in points]
        assert found == pytest.approx(distances)
    pose = np.zeros((5, 1, 3))
    pose[:, 0, 0] = np.arange(5.0)
    point = np.zeros((5, 2, 2))
    point[:, 1, 1] = 1.0
    found = outlines.distance(there, 0, pose, point)
    assert (found[:, 0], found[0, 1]) == (pytest.approx([-0.1, 0.8, 1.8, 2.8, 3.8]), pytest.approx(0.9))


def test_planned_poses_over_time():
    plans = {"o0": Line(move_by=[1.0, 0.5], speed_=0.2), "o1": Circle(radius=0.5, period_s=10.0)}
    there = scene(BOX, POST, FENCE, plans=plans)
    time = np.linspace(-1.0, 20.0, 43)
    path = there.along(time)
    assert path == pytest.approx(np.array([there.at(t) for t in time]))
    assert path[time <= 0.0, 0] == pytest.approx(np.tile(there.pose[0], (3, 1)))
    assert path[-1, 0] == pytest.approx([2.0, 1.0, 0.5 * math.pi])
    assert path[-1, 1:] == pytest.approx(there.pose[1:])  # back after two turns
    assert there.poses(20.0) == [tuple(pose) for pose in there.at(20.0).tolist()]


def test_heights_overlap_between_bottom_and_top():
    there = scene(Obstacle(radius=0.1, bottom=1.0, height=0.5), Obstacle(radius=0.1))
    for low, overlaps in ((0.7, False), (0.9, True), (1.4, True), (1.6, False)):
        assert bool(outlines.at_height(there, 0, low, low + 0.2)) == overlaps
    assert bool(outlines.at_height(there, 1, 1.8, 1.9))  # up to the ceiling


def test_obstacles_outside_the_arena():
    turned = math.pi / 4.0
    for obstacle, out in (
        (Obstacle(radius=0.5, at=(2.3, 0.0)), False),
        (Obstacle(radius=0.5, at=(2.4, 2.4)), True),  # nearer than its radius along both axes, but not to the corner
        (Obstacle(box=(1.0, 1.0), at=(2.6, 0.0)), True),
        (Obstacle(box=(1.0, 1.0), at=(2.6, 0.0), yaw=turned), False),
        (Obstacle(box=(1.0, 1.0), at=(2.45, 2.45), yaw=turned), True),  # its side faces the corner
        (Obstacle(wall=[(3.0, 0.0), (0.0, 3.0)]), False),
        (Obstacle(wall=[(4.5, 0.0), (0.0, 4.5)]), True),  # cuts the corner off, outside
        (Obstacle(wall=[(2.0, -1.0), (2.0, 1.0)]), False),  # on the border
    ):
        assert outlines.outside(scene(obstacle), 0) is out
