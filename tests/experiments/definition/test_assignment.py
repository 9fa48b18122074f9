"""Assignments: each robot has its own part of the experiment."""

import math

import msgspec
import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from agents.body.limits import Safety
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins.laws import Distance
from agents.plugins.planners import Line
from agents.plugins.triggers import Periodic, SendOnDelta
from experiments.definition import bodies
from experiments.definition.experiment import Arena, Formation, LinkTable, Rates, RobotTable, Start
from experiments.definition.plan import Plan
from tests.experiments.definition.test_graph import HEARS
from tests.small import reference, small
from twins.scene import Obstacle

NAMES = ("TB01", "KH01", "KH02", "KH03", "CF01", "CF02", "CF03")


@pytest.fixture(scope="module")
def reference_plan():
    return Plan(reference("periodic"))


def test_part_of_the_leader(reference_plan):
    made = reference_plan.assignment("TB01")
    assert (made.name, made.kind, made.neighbours, made.guided) == ("TB01", TURTLEBOT3, (), False)
    assert math.isnan(made.hover)
    assert made.law == Distance()
    assert made.trigger == Periodic(period_s=0.02)
    assert (made.clamp, made.tracking_gain, made.duration) == (0.1, 3.0, 45.0)
    assert (made.body_hz, made.pose_every, made.decide_every) == (100.0, 2, 10)
    assert made.patience_s is None
    assert [reference_plan.assignment(name).ground for name in NAMES] == [0.0] * 4 + [0.8] * 3
    (leg,) = made.legs
    assert (leg.at, leg.planner) == (21.0, Line(move_by=[0.75, 0.0], speed_=0.15))


def test_links_of_the_paper(reference_plan):
    """Eq. (11) and figure 11: 12 edges, three of them from the leader only."""
    net = reference_plan.links
    assert {i: tuple(net.sender[net.receiver == i].tolist()) for i in range(1, 7)} == HEARS
    assert 0 not in net.receiver
    distance = {(NAMES[i], NAMES[j]): d for i, j, d in zip(net.receiver, net.sender, net.distance, strict=True)}
    assert distance["KH01", "KH03"] == distance["KH03", "KH01"] == pytest.approx(0.6 * math.sqrt(2))
    assert distance["CF01", "TB01"] == distance["KH02", "CF02"] == 0.86
    drones = {4, 5, 6}
    by_drone = [bool({i, j} & drones) for i, j in zip(net.receiver.tolist(), net.sender.tolist(), strict=True)]
    np.testing.assert_array_equal(net.gain, np.where(by_drone, 1.0, 3.0))
    for row, name in enumerate(NAMES):
        known = reference_plan.assignment(name).neighbours
        assert [link.sender for link in known] == net.sender[net.receiver == row].tolist()
        assert [link.distance for link in known] == net.distance[net.receiver == row].tolist()
        assert all(link.name == NAMES[link.sender] and link.in_law for link in known)


def three(**parts):
    robots = {
        "A": RobotTable(kind="khepera4", start=[0.5, -0.5, 1.5]),
        "B": RobotTable(kind="crazyflie", start=[0.0, 0.25], hover=0.7),
        "C": RobotTable(kind="turtlebot3", start=[-0.5, 0.0]),
    }
    return Plan(small(robots, **parts))


def test_bodies_start_on_the_floor_with_a_yaw(reference_plan):
    made = bodies.body_request(reference_plan, NAMES, 5)
    assert (made.names, made.seeds, made.addresses) == (NAMES, (5,) * 7, ("twin",) * 7)
    assert made.rate_hz == 100.0
    assert (made.start[0], made.start[4]) == ((-0.6, 0.8, 0.0), (-0.2, 0.4, 0.0))
    assert three().start_poses() == ([(0.5, -0.5, 0.0), (0.0, 0.25, 0.0), (-0.5, 0.0, 0.0)], [1.5, 0.0, 0.0])


def test_limits_are_arena_and_safety_of_the_file():
    safety = Safety(speed=0.3, max_goal_distance=0.2, margin=0.1)
    made = three(arena=Arena(size=(2.0, 3.0, 4.0)), safety=safety).limits("A")
    assert (made.low, made.high) == ((-1.0, -1.5, 0.0), (1.0, 1.5, 4.0))
    assert (made.speed, made.max_goal_distance, made.margin) == (0.3, 0.2, 0.1)
    assert (made.position_timeout_s, made.neighbour_timeout_s) == (0.5, 1.0)
    assert three().limits("A").top_speed == np.inf


def test_links_may_have_gains_of_their_own():
    given = {"A > B": LinkTable(distance=0.5, gain=7.0), "B - C": 0.6, "C > A": LinkTable(distance=1.0)}
    net = three(formation=Formation(gain=2.0, links=given)).links
    table = zip(*(column.tolist() for column in (net.receiver, net.sender, net.distance, net.gain)), strict=True)
    assert list(table) == [(0, 2, 1.0, 2.0), (1, 0, 0.5, 7.0), (1, 2, 0.6, 2.0), (2, 1, 0.6, 2.0)]


def test_who_leads():
    def leaders(*links, leader=None):
        return list(three(formation=Formation(links=dict.fromkeys(links, 1.0), leader=leader)).leaders)

    assert leaders() == []  # no robot receives
    assert leaders("A > B", "A > C") == ["A"]
    assert leaders("A > B") == ["A", "C"]
    assert leaders("A - B", "B > C") == []
    assert leaders("A - B", leader="B") == ["B"]


def test_disturbances_merge_field_by_field_the_narrower_wins():
    given = {
        "all": Disturbance(position_sigma=0.001, yaw_sigma=0.01, latency_s=0.1),
        "crazyflie": Disturbance(hover_jitter=Jitter(0.01), latency_s=0.2),
        "B": Disturbance(position_sigma=0.0),
    }
    made = three(disturbance=given)
    assert made.disturbance("A") == given["all"]
    assert made.disturbance("B") == Disturbance(Jitter(0.01), 0.0, 0.01, 0.2)
    assert three().disturbance("A") == Disturbance()


def test_rates_patience_and_triggers():
    rates = Rates(body_hz=200.0, pose_hz=40.0, coordination_hz=20.0)
    trigger = {"kind": "send-on-delta", "threshold": 0.02, "maximum_silence_s": 1.0}
    made = three(rates=rates, start=Start(deadline_s=7.0, missing="go-on"), trigger=trigger).assignment("A")
    assert (made.body_hz, made.pose_every, made.decide_every, made.patience_s) == (200.0, 5, 10, 7.0)
    assert made.trigger == SendOnDelta(threshold=0.02, maximum_silence_s=1.0)
    with pytest.raises(msgspec.ValidationError, match="threshold"):
        three(trigger={**trigger, "threshold": -1.0}).assignment("A")


def test_robots_are_not_scattered_into_obstacles():
    robots = {name: RobotTable(kind="khepera4", start=[-0.5, y]) for name, y in (("A", -0.5), ("B", 0.5))}
    arena = Arena(obstacles={"post": Obstacle(radius=0.3, at=(0.0, 0.0))})
    plan = Plan(small(robots, arena=arena, start=Start(scatter=0.6)))
    place = np.array([bodies.scattered_poses(plan, ("A", "B"), seed)[0] for seed in range(100)])
    gap = np.hypot(place[..., 0], place[..., 1]) - 0.3 - 0.07
    assert gap.min() > bodies.CLEAR
    assert gap.min() < 0.1  # it is near enough to be in the way
