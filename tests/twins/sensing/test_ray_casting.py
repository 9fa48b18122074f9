"""Rays against pymunk's own queries, and what they must and must not see."""

import math
from itertools import pairwise

import numpy as np
import pymunk
import pytest

from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from twins.scene import Obstacle, Scene
from twins.sensing.ray_casting import BUDGET, Beams, Caster, Fan

LOW = 0.01  # [m] everything that stands on the floor spans this height
UP, DOWN = 0.5 * math.pi, -0.5 * math.pi


def fan(bearing, reach=3.0, height=LOW, elevation=None):
    bearing = np.asarray(bearing, dtype=float)
    return Fan(bearing, np.zeros(len(bearing)) if elevation is None else np.asarray(elevation), height, reach)


def furnished(obstacles=None, *, walled=False, size=(6.0, 6.0, 2.5)):
    return Scene.furnished(size, obstacles or {}, {}, walled=walled)


def look(position, fans, *, kinds=None, yaw=None, scene=None, obstacles=None, row=None, which=None, **options):
    """Distances (F, m) that rows see, one fan each unless said otherwise."""
    position = np.asarray(position, dtype=float)
    n = len(position)
    scene = furnished() if scene is None else scene
    obstacles = scene.pose if obstacles is None else obstacles
    row = np.arange(n) if row is None else np.asarray(row)
    beams = Beams(fans, row, np.zeros(len(row), dtype=int) if which is None else np.asarray(which), **options)
    caster = Caster(scene, kinds or [KHEPERA4] * n)
    seen = caster.cast(beams, position, np.zeros(n) if yaw is None else np.asarray(yaw), obstacles)
    return seen.reshape(len(row), -1) if which is None else seen


CROWD = (KHEPERA4, TURTLEBOT3, CRAZYFLIE, KHEPERA4, TELLO)
THINGS = {
    "box": Obstacle(box=(0.5, 0.3)),
    "pillar": Obstacle(radius=0.2),
    "wall": Obstacle(wall=[(-0.6, 0.0), (0.1, 0.4), (0.6, 0.0)]),
}


def by_pymunk(position, angles, reach, scene, pose):
    space = pymunk.Space()
    for row, (place, kind) in enumerate(zip(position, CROWD, strict=True)):
        shape = pymunk.Circle(space.static_body, kind.radius, tuple(place[:2]))
        shape.filter = pymunk.ShapeFilter(categories=2 << row)
        space.add(shape)
    box, pillar, wall = bodies = [pymunk.Body(body_type=pymunk.Body.STATIC) for _ in pose]
    for body, (x, y, angle) in zip(bodies, pose, strict=True):
        body.position, body.angle = (x, y), angle
    low, high = scene.low[:2].tolist(), scene.high[:2].tolist()
    border = [low, (high[0], low[1]), high, (low[0], high[1]), low]
    space.add(*bodies, pymunk.Poly(box, scene.outline[0].tolist()), pymunk.Circle(pillar, scene.radius[1]))
    for body, points in ((wall, scene.outline[2].tolist()), (space.static_body, border)):
        space.add(*(pymunk.Segment(body, tuple(a), tuple(b), 0.0) for a, b in pairwise(points)))
    seen = np.full(angles.shape, np.nan)
    for row, k in np.ndindex(angles.shape):
        others = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ (2 << row))
        (x, y, _), angle = position[row], angles[row, k]
        end = x + reach * math.cos(angle), y + reach * math.sin(angle)
        if (hit := space.segment_query_first((x, y), end, 0.0, others)) is not None:
            seen[row, k] = reach * hit.alpha
    return seen


@pytest.mark.parametrize("budget", [BUDGET, 300])
def test_random_scenes_are_seen_as_pymunk_sees_them(budget):
    rng = np.random.default_rng(4)
    scene = furnished(THINGS, walled=True, size=(4.0, 3.0, 2.5))
    n, reach = len(CROWD), 2.2
    bearing = np.sort(rng.uniform(-7.0, 7.0, 70))  # irregular, and more than a turn
    rng.shuffle(bearing)
    for _ in range(12):
        position, yaw = np.zeros((n, 3)), rng.uniform(-20.0, 20.0, n)
        position[:, :2] = rng.uniform([-1.9, -1.4], [1.9, 1.4], (n, 2))
        pose = rng.uniform([-2.0, -1.5, -9.0], [2.0, 1.5, 9.0], (len(THINGS), 3))
        seen = look(position, [fan(bearing, reach)], kinds=CROWD, yaw=yaw, scene=scene, obstacles=pose, budget=budget)
        expected = by_pymunk(position, yaw[:, None] + bearing, reach, scene, pose)
        assert np.isfinite(expected).mean() > 0.6
        outside = (expected != 0.0).all(axis=1)  # inside a thing pymunk says 0, and we see through it
        assert outside.sum() >= 2
        np.testing.assert_allclose(seen[outside], expected[outside], rtol=0.0, atol=1e-9)


def test_a_robot_and_a_wall_at_known_distances():
    seen = look(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        [fan([0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi])],
        yaw=[0.0, math.pi],
        scene=furnished(walled=True, size=(4.0, 5.0, 2.5)),
    )
    np.testing.assert_allclose(seen, [[0.93, 2.5, 2.0, 2.5], [0.93, 2.5, 1.0, 2.5]], atol=1e-12)
    other = KHEPERA4.radius + 2.0  # reach counts from the centre to the surface
    assert np.isnan(look([[0.0, 0.0, 0.0], [other + 1e-6, 0.0, 0.0]], [fan([0.0], 2.0)])[0])
    seen = look(  # who is absent neither sees nor is seen
        [[0.0, 0.0, 0.0], [np.nan] * 3, [1.0, 0.0, 0.0]],
        [fan([0.0, 0.0], elevation=[0.0, 0.5 * math.pi])],
        scene=furnished(walled=True),
    )
    np.testing.assert_allclose(seen, [[0.93, 2.49], [np.nan, np.nan], [2.0, 2.49]], atol=1e-12)


def test_open_room_has_a_floor_and_nothing_else():
    with pytest.raises(ValueError, match=r"level .* or vertical"):
        fan([0.0], elevation=[0.3])
    assert np.isnan(look([[0.0, 0.0, 0.0]], [fan(np.arange(12.0))])).all()
    assert look(np.zeros((1, 3)), [fan([])]).shape == (1, 0)
    seen = look([[0.0, 0.0, 1.0]], [fan([0.0, 0.0], elevation=[UP, DOWN])])
    np.testing.assert_allclose(seen, [[np.nan, 1.01]], atol=1e-12)


@pytest.mark.parametrize(
    ("height", "expected"),
    [(0.02, 0.5 - 0.070), (0.1, 1.0 - 0.105), (0.3, 1.6 - 0.2), (0.6, 2.4 - 0.1), (1.03, 2.0 - 0.065), (1.5, 3.0)],
)
def test_a_level_ray_sees_what_spans_its_height(height, expected):
    """Khepera, TurtleBot, a box up to 0.5 m, a Crazyflie at 1 m, a box from 0.55 m to 0.95 m, and the border."""
    low = Obstacle(box=(0.4, 0.4), at=(1.6, 0.0), height=0.5)
    hung = Obstacle(radius=0.1, at=(2.4, 0.0), bottom=0.55, height=0.4)
    scene, kinds = furnished({"low": low, "hung": hung}, walled=True), [KHEPERA4, KHEPERA4, TURTLEBOT3, CRAZYFLIE]
    position = [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 1.01]]
    seen = look(position, [fan([0.0], 4.0, height)], kinds=kinds, scene=scene, row=[0])
    np.testing.assert_allclose(seen, [[expected]], atol=1e-12)


def test_vertical_rays_see_nearest_things_above_and_below():
    scene = furnished(
        {
            "shelf": Obstacle(box=(1.0, 0.2), at=(0.0, 0.0), yaw=0.5 * math.pi, bottom=1.5, height=0.1),
            "table": Obstacle(radius=0.3, at=(0.0, 0.0), height=0.4),
            "roof": Obstacle(box=(3.0, 3.0), bottom=2.0, height=0.1),
            "wall": Obstacle(wall=[(-1.0, 0.0), (1.0, 0.0)], bottom=1.2, height=0.1),
        },
        walled=True,
    )
    position, expected = zip(
        ([0.0, 0.0, 1.0], [0.49, 0.61]),  # the shelf over it, the table under it
        ([0.0, 0.4, 1.0], [0.49, 1.01]),  # the shelf is turned; the floor
        ([0.4, 0.0, 1.0], [0.99, 1.01]),  # the roof only: a thin wall covers nothing
        ([2.0, 2.0, 1.0], [0.29, 1.01 - 0.029]),  # other robots
        ([2.05, 2.0, 1.3], [1.19, 1.31 - 1.029]),  # the ceiling
        ([2.0, 2.0, 0.0], [0.99, 0.01]),
        strict=True,
    )
    seen = look(position, [fan([0.0, 0.0], 4.0, elevation=[UP, DOWN])], kinds=[CRAZYFLIE] * 6, scene=scene)
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_corners_are_tight():
    scene = furnished(walled=True, size=(4.0, 4.0, 1.0))
    for x, y, yaw in np.random.default_rng(1).uniform(-1.9, 1.9, (200, 3)):
        aim = math.atan2(2.0 - y, -2.0 - x) - yaw  # meets one of both walls
        seen = look([[x, y, 0.0]], [fan([aim], 9.0)], yaw=[yaw], scene=scene)
        assert seen[0, 0] == pytest.approx(math.hypot(-2.0 - x, 2.0 - y), abs=1e-7)
    scene = furnished({"box": Obstacle(box=(1.0, 1.0)), "pillar": Obstacle(radius=0.4)}, walled=True)
    seen = look([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]], [fan([0.0, 1.5, -2.0], 5.0)], scene=scene)  # from inside things
    np.testing.assert_allclose(seen[0], [3.0, 3.0 / math.sin(1.5), 3.0 / math.sin(2.0)], atol=1e-12)


def test_rows_send_several_fans_without_affecting_each_other():
    position = [[0.0, 0.0, 0.0], [0.5, 0.3, 0.0], [-0.4, 0.6, 0.0]]
    near, wide = fan(np.linspace(0.0, 6.0, 25), 0.45), fan(np.linspace(-1.0, 5.0, 40), 3.0)
    both = look(position, [near, wide], row=[2, 0, 0], which=[1, 0, 1])
    alone = [look(position, [each])[row] for row, each in ((2, wide), (0, near), (0, wide))]
    np.testing.assert_array_equal(both, np.concatenate(alone))
