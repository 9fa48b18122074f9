"""Obstacles and expected motions in figures."""

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from experiments.check.check import analyses
from experiments.definition.experiment import Arena, StartBox
from experiments.file import document
from experiments.report import scenery, trajectories
from experiments.report.trajectories import expected_motion
from tests.experiments.traces import park
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
HALL = Arena(size=(30.0, 30.0, 3.0))


RUN = park(duration=3.0)


def from_above(arena):
    axes = Figure().subplots()
    scenery.from_above(axes, RUN.plan.changed(arena=arena))
    return axes


def in_space(arena, scale=1.0):
    moved = dataclasses.replace(RUN, plan=RUN.plan.changed(arena=arena), true_position=RUN.true_position * scale)
    return trajectories.formation([moved]).axes[0]


def test_everything_stands_in_the_plan_where_it_stands():
    axes = from_above(FULL)
    boxes = [each.get_bbox().bounds for each in axes.patches if isinstance(each, Rectangle)]
    assert np.array(boxes) == pytest.approx(np.array([(-1.4, -0.5, 0.8, 1.0), (-1.5, -1.0, 3.0, 2.0)]))
    polygons = [each for each in axes.patches if isinstance(each, Polygon)]
    post, crate, cart, arrived, lamp = (each.get_xy()[:-1] for each in polygons)
    assert np.hypot(*(post - [1.0, 0.5]).T) == pytest.approx(np.full(scenery.ROUND, 0.1))
    assert (crate.min(axis=0), crate.max(axis=0)) == (pytest.approx([-1.2, 0.4]), pytest.approx([-0.8, 0.6]))
    assert arrived - cart == pytest.approx(np.tile([1.0, 0.0], (4, 1)))
    assert lamp.mean(axis=0) == pytest.approx([0.5, 0.0])
    way, fence = (np.array(line.get_data()).T for line in axes.lines)
    assert way[[0, -1]] == pytest.approx(np.array([[0.0, -0.8], [1.0, -0.8]]))
    assert fence == pytest.approx(np.array([[-1.4, -0.9], [-0.9, -0.9], [-0.9, -0.4]]))
    assert [text.get_text() for text in axes.texts] == list(FULL.obstacles)
    post, crate, cart, arrived, lamp = polygons  # told apart without colour
    assert (bool(crate.get_hatch()), bool(post.get_hatch())) == (True, False)
    borders = [from_above(Arena(walls=walls)).patches[0] for walls in (True, False)]
    for solid, dashed in ((post, lamp), (cart, arrived), borders):
        assert solid.get_linestyle() != dashed.get_linestyle()


def test_the_legend_names_what_there_is():
    full = RUN.plan.changed(arena=FULL)
    said = [[*scenery.legend(plans)] for plans in ([RUN.plan], [full, full])]
    assert said == [[], ["obstacle", "can be pushed", "obstacle's path", "wall", "above the floor", "start box"]]
    assert "above the floor" not in scenery.legend([full], space=True)


def test_spatial_obstacles_reach_over_the_shown_height():
    axes = in_space(FULL)
    solids = [each for each in axes.collections if isinstance(each, Poly3DCollection)]
    assert len(solids) == 2 * 3 + 1  # sides and ends of what is closed, the fence; the lamp hangs above it all
    heights = [np.array(each._faces)[..., 2] for each in solids]
    assert axes.get_zlim() == (0.0, pytest.approx(max(height.max() for height in heights)))
    assert (heights[-1].min(), heights[-1].max()) == pytest.approx((0.0, 0.2))


@pytest.mark.slow
def test_space_shows_whole_arena_unless_far_larger():
    assert in_space(EMPTY).get_xlim() == pytest.approx((-1.08 * 1.1, 1.08 * 1.1))
    assert np.ptp(in_space(HALL).get_xlim()) < 3.0
    pillar = {"pillar": Obstacle(radius=0.2, at=(-4.0, 3.0))}
    axes = in_space(Arena(size=HALL.size, obstacles=pillar))
    assert (axes.get_xlim()[0] < -4.2, axes.get_ylim()[1] > 3.2) == (True, True)
    for arena, top in ((EMPTY, 0.216), (FULL, 0.15 * 1.08 * 3.0)):  # robots on the floor stand on it
        assert in_space(arena, [1.0, 1.0, 0.0]).get_zlim() == pytest.approx((0.0, top))


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
