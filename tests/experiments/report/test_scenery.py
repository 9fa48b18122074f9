"""Obstacles and expected motions in figures."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from experiments.check.check import analyses
from experiments.definition.experiment import Arena, StartBox
from experiments.file import document
from experiments.report import scenery, style, trajectories
from experiments.report.trajectories import expected_motion
from tests.experiments.traces import crowd, park
from twins.scene import Obstacle

FULL = Arena(
    size=(3.0, 2.0, 2.5),
    obstacles={
        "post": Obstacle(radius=0.1, at=(1.0, 0.5)),
        "crate": Obstacle(box=(0.4, 0.2), at=(-1.0, 0.5), mass=1.0),
        "cart": Obstacle(box=(0.2, 0.2), at=(0.0, -0.8), plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.5}),
        "fence": Obstacle(wall=[(0.0, 0.0), (0.5, 0.0), (0.5, 0.5)], at=(-1.4, -0.9), height=0.2),
        "lamp": Obstacle(radius=0.2, at=(0.5, 0.0), bottom=1.5),
    },
    starts={"west": StartBox(at=(-1.0, 0.0), size=(0.8, 1.0))},
)
EMPTY = Arena(size=(2.2, 2.0, 2.5))


def within(trace, arena):
    return dataclasses.replace(trace, plan=trace.plan.changed(arena=arena))


@pytest.fixture(scope="module")
def short():
    return park(duration=3.0)


def from_above(trace, arena):
    axes = Figure().subplots()
    scenery.from_above(axes, within(trace, arena).plan)
    return axes


def test_everything_stands_in_the_plan_where_it_stands(short):
    axes = from_above(short, FULL)
    box, border = (each for each in axes.patches if isinstance(each, Rectangle))
    assert (box.get_x(), box.get_y(), box.get_width(), box.get_height()) == pytest.approx((-1.4, -0.5, 0.8, 1.0))
    assert (border.get_x(), border.get_y(), border.get_width(), border.get_height()) == (-1.5, -1.0, 3.0, 2.0)
    post, crate, cart, arrived, lamp = (each.get_xy()[:-1] for each in axes.patches if isinstance(each, Polygon))
    assert np.hypot(*(post - [1.0, 0.5]).T) == pytest.approx(np.full(scenery.ROUND, 0.1))
    assert (crate.min(axis=0), crate.max(axis=0)) == (pytest.approx([-1.2, 0.4]), pytest.approx([-0.8, 0.6]))
    assert arrived - cart == pytest.approx(np.tile([1.0, 0.0], (4, 1)))
    assert lamp.mean(axis=0) == pytest.approx([0.5, 0.0])
    way, fence = (np.array(line.get_data()).T for line in axes.lines)
    assert way[[0, -1]] == pytest.approx(np.array([[0.0, -0.8], [1.0, -0.8]]))
    assert fence == pytest.approx(np.array([[-1.4, -0.9], [-0.9, -0.9], [-0.9, -0.4]]))
    assert [text.get_text() for text in axes.texts] == list(FULL.obstacles)


def test_sorts_of_obstacles_are_told_apart_without_colour(short):
    patches = from_above(short, FULL).patches
    post, crate, cart, arrived, lamp = (each for each in patches if isinstance(each, Polygon))
    assert crate.get_hatch()
    assert not post.get_hatch()
    assert lamp.get_linestyle() != post.get_linestyle()
    assert arrived.get_linestyle() != cart.get_linestyle()
    colours = [each.get_facecolor() for each in (post, crate, cart, lamp)]
    assert all(red == green == blue for red, green, blue, _ in colours)


def test_a_border_without_walls_is_dashed(short):
    borders = [from_above(short, Arena(walls=walls)).patches[0] for walls in (True, False)]
    assert [border.get_linestyle() for border in borders] == ["solid", "--"] or (
        borders[0].get_linestyle() != borders[1].get_linestyle()
    )


def test_the_legend_names_what_there_is(short):
    assert scenery.legend([short.plan]) == {}
    full = within(short, FULL).plan
    said = [*scenery.legend([full])]
    assert said == ["obstacle", "can be pushed", "obstacle's path", "wall", "above the floor", "start box"]
    assert [*scenery.legend([full, full])] == said
    assert "above the floor" not in scenery.legend([full], space=True)


def test_spatial_obstacles_reach_over_the_shown_height(short):
    axes = trajectories.formation([within(short, FULL)]).axes[0]
    low, high = axes.get_zlim()
    assert low == 0.0
    solids = [each for each in axes.collections if isinstance(each, Poly3DCollection)]
    assert len(solids) == 2 * 3 + 1  # sides and ends of what is closed, the fence; the lamp hangs above it all
    heights = [np.array(each._faces)[..., 2] if len(each._faces) else None for each in solids]
    assert max(height.max() for height in heights) == pytest.approx(high)
    fence = heights[-1]
    assert (fence.min(), fence.max()) == pytest.approx((0.0, 0.2))


def test_space_shows_whole_arena_unless_far_larger(short):
    near = trajectories.formation([within(short, EMPTY)]).axes[0]
    assert near.get_xlim() == pytest.approx((-1.08 * 1.1, 1.08 * 1.1))
    far = trajectories.formation([within(short, Arena(size=(30.0, 30.0, 3.0)))]).axes[0]
    assert np.ptp(far.get_xlim()) < 3.0
    hall = Arena(size=(30.0, 30.0, 3.0), obstacles={"pillar": Obstacle(radius=0.2, at=(-4.0, 3.0))})
    axes = trajectories.formation([within(short, hall)]).axes[0]
    assert axes.get_xlim()[0] < -4.2
    assert axes.get_ylim()[1] > 3.2


@pytest.mark.slow
@pytest.mark.parametrize("draw", [trajectories.formation, trajectories.plan_view])
def test_pictures_of_full_arenas_are_drawn(draw, short):
    figure = draw([within(short, FULL), within(short, EMPTY)])
    assert figure.get_figwidth() == 3.5
    assert "<svg" in style.svg(figure)
    assert "<svg" in style.svg(draw([within(crowd(3, duration=1.0), FULL)]))


def test_robots_on_the_floor_stand_on_it(short):
    flat = dataclasses.replace(short, true_position=short.true_position * [1.0, 1.0, 0.0])
    for arena, top in ((EMPTY, 0.216), (FULL, 0.15 * 1.08 * 3.0)):
        low, high = trajectories.formation([within(flat, arena)]).axes[0].get_zlim()
        assert (low, high) == pytest.approx((0.0, top))


@pytest.mark.slow
def test_target_shape_is_laid_on_the_leader():
    given = document.read("robotic-park", ["timeline=[]", "duration_s=15"])
    known = analyses(given.cases())["event"]
    axes = expected_motion({"event": known}).axes[0]
    target = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "D"]
    leader = known.plan.names.index("TB01")
    assert target[leader] == pytest.approx(known.start[leader, :2], abs=1e-9)
    ends = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o" and line.get_markersize() == 3.5]
    assert np.array(ends) == pytest.approx(known.prediction.position[-1, :, :2])
    assert np.linalg.norm(np.array(target) - ends, axis=1).max() < 0.2
