"""The scene of a case at one moment: what is drawn where, in which colour and condition. No browser."""

from dataclasses import replace
from math import inf
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from agents.body.kinds import KINDS
from agents.network import messages
from experiments.definition.experiment import Arena, LinkTable
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.scene import drawing, markers, models, stage
from experiments.scene.condition import Condition
from experiments.scene.stage import BodyLocation, LinkTracker, Moment, SceneModel, Trail
from tests.experiments.traces import link_errors
from tests.small import small
from twins.scene import Obstacle


def status(phase="running", **fields):
    return messages.Status(**{"robot": "CF01", "stamp": 0.0, "phase": phase, "reason": "", **fields})


@pytest.fixture(scope="module")
def park_scene():
    return SceneModel.of_plan(load("robotic-park").cases()["event"])


def unknown(scene):
    """A moment at which nothing is known yet."""
    rows, net = len(scene.names), len(scene.links)
    blank = np.full((rows, 3), np.nan)
    return Moment(
        blank, np.full(rows, np.nan), blank.copy(), np.full(rows, int(Condition.WAITING)), np.full(rows, inf),
        np.full(net, np.nan), np.zeros(net, dtype=bool), scene.scene.pose.copy(), np.zeros((rows, 0, 3)),
    )  # fmt: skip


def at_start(park_scene):
    moment = unknown(park_scene)
    for row, robot in enumerate(park_scene.plan.experiment.robots.values()):
        moment.position[row] = (*robot.start[:2], robot.hover or 0.0)
    return moment


def test_bodies_and_links_are_told_apart():
    bodies = {"twin": "TWIN", "crazyflie-twin": "TWIN", "world": "WORLD", "radio://0/80/2M/E7E7E7E701": "REAL"}
    assert {body: stage.place_of(body).name for body in bodies} == bodies
    assert len({tuple(colour) for colour in stage.CHASSIS.values()}) == len(BodyLocation)
    colours = stage.link_colours(np.array([0.024, 0.026, 0.049, 0.051, np.nan]))
    assert [*map(tuple, colours.tolist())] == [stage.GOOD, stage.FAIR, stage.FAIR, stage.BAD, stage.UNKNOWN]
    made = stage.dashes(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]))
    assert np.linalg.norm(made[:, 1] - made[:, 0], axis=1).sum() == pytest.approx(0.5)
    assert 0.0 <= made[..., 0].min() <= made[..., 0].max() <= 1.0


def test_errors_are_those_of_the_law(park_scene):
    moment = at_start(park_scene)
    error, net = LinkTracker(park_scene).errors(None, moment.position), park_scene.links
    assert error == pytest.approx(link_errors(net, moment.position))
    of_robots = LinkTracker(park_scene).of_robots(error)
    assert [park_scene.names[k] for k in np.flatnonzero(np.isnan(of_robots))] == ["TB01"], "it receives on no link"
    assert of_robots[1] == pytest.approx(error[net.receiver == 1].sum())


def test_absent_links_plugins_or_experiments_have_no_error(park_scene):
    link, place = LinkTable(distance=0.5, from_s=3.0), np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])
    tracker = LinkTracker(SceneModel.of_plan(Plan(small({"A": "khepera4", "B": "khepera4"}, {"A > B": link}))))
    assert np.isnan(tracker.errors(1.0, place)).all()
    assert tracker.errors(4.0, place) == pytest.approx([0.1])
    formation = msgspec.structs.replace(park_scene.plan.experiment.formation, law="not-here")
    other = SceneModel.of_plan(park_scene.plan.changed(formation=formation, avoidance="not-here"))
    assert np.isnan(LinkTracker(other).errors(0.0, at_start(park_scene).position)).all()
    assert LinkTracker(SceneModel.of_robots(("A", "B"))).errors(None, np.zeros((2, 3))).shape == (0,)


def test_unknown_robots_are_out_of_sight(park_scene):
    moment = unknown(park_scene)
    assert (stage.shown(moment.position)[:, 2] < -100.0).all()
    ends = stage.segments(park_scene, moment.position)
    assert (stage.visible(ends, np.ones(len(ends), dtype=bool))[..., 2] < -100.0).all()
    assert len(stage.dashes(ends)) == 0


def test_attention_has_ring_word_and_lit_links(park_scene):
    moment = at_start(park_scene)
    row = park_scene.names.index("CF02")
    moment.condition[:] = Condition.ACTIVE
    moment.condition[row] = Condition.LOST
    places, _ = stage.rings(moment)
    assert np.flatnonzero(places[:, 2] > -100.0).tolist() == [row]
    said = [stage.label(park_scene, row, condition) for condition in (Condition.LOST, Condition.ACTIVE)]
    assert said == ["CF02 · LOST", "CF02"]
    assert (stage.accents(park_scene, moment)[row] != park_scene.colours[row]).any()
    moment.silent_for[park_scene.names.index("TB01")] = 0.05
    senders = {park_scene.names[row] for row in park_scene.links.sender[stage.lit(park_scene, moment)]}
    assert senders == {"TB01"}  # it transmitted


def test_trail_has_five_fading_points_a_second(park_scene):
    trail = Trail(2)
    kept = [trail.add(0.1 * k, np.full((2, 3), 0.1 * k)) for k in range(9)]
    assert kept == [k % 2 == 0 for k in range(9)]
    assert trail.points[0, :5, 0] == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.0])
    ends = stage.trail_segments(trail.points)
    assert (ends[:, 0, 2] > -100.0).sum() == 2 * 4
    colours = stage.trail_colours(park_scene, 60, (255, 255, 255))
    assert colours[58, 1].tolist() == [204, 226, 239]  # nearly that of the background


@pytest.mark.parametrize("bearing", [[0.0, 1.0], [0.0]], ids=["whole", "cut"])
def test_ranges_reach_from_robot_to_what_it_sees(park_scene, bearing):
    moment = at_start(park_scene)
    moment.yaw[:] = np.pi / 2
    scan = messages.Ranges("KH01", 0.0, bearing, [0.0, 0.0], [0.5, None, 0.3] if len(bearing) == 1 else [0.5, None])
    (line,) = stage.rays(park_scene, moment, {"KH01": scan})
    assert line[1] - line[0] == pytest.approx([0.0, 0.5, 0.0])


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_every_kind_has_a_model_of_its_size(kind, own):
    kind = kind if own else replace(kind, name="my-kind")
    model = models.model(kind).whole
    a, b, c = (model.vertices[model.faces[:, k].astype(int)] for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0.0  # six times the volume: faces look outward
    low, high = model.vertices.min(axis=0), model.vertices.max(axis=0)
    assert (low[2], high[2]) == pytest.approx((0.0, kind.height), abs=1e-9)
    assert np.hypot(*model.vertices[:, :2].T).max() == pytest.approx(kind.radius, rel=0.35)


def test_obstacles_stand_where_the_file_says():
    scene = SceneModel.of_plan(load("obstacle-course").plan).scene
    for k in range(len(scene.names)):
        height = models.obstacle(scene, k).vertices[:, 2]
        assert (height.min(), height.max()) == pytest.approx((scene.bottom[k], scene.top[k]))
    lamp = Obstacle(radius=0.2, at=(0.5, 0.0), bottom=1.4, height=0.3)
    drawn = markers.drawing(Plan(small({"A": "khepera4"}, arena=Arena(obstacles={"lamp": lamp}))))(0.0, {})
    (marker,) = [each for each in drawn if each.group == "obstacles"]
    assert (marker.scale[2], marker.position[2]) == pytest.approx((0.3, 1.55))


def test_dark_bodies_and_worst_of_many_are_seen():
    robots = {f"R{k:02}": "khepera4" for k in range(30)}
    scene = SceneModel.of_plan(Plan(small(robots, {f"R00 > R{k:02}": 0.5 for k in range(1, 30)})))
    real = replace(scene, places=(BodyLocation.REAL,) * 30)
    server = MagicMock()
    drawn = drawing.SceneDrawing(server, real, drawing.DARK)
    body = server.scene.add_batched_meshes_simple.call_args_list[0]
    assert body.kwargs["batched_colors"].min() > 30, "linear light"
    moment = at_start(real)
    moment.condition[:] = Condition.ACTIVE
    moment.error = 0.001 * np.arange(len(real.links))
    drawn._draw_labels(moment)
    named = {call.args[1] for call in server.scene.add_label.call_args_list}
    assert named == {"R00 · real", *(f"R{k} · real" for k in range(25, 30))}
