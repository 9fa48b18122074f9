"""Robots on standby and spares: what the file may say, what runs without them, and who takes over a name."""

import pytest

from agents.body.interface import BodyState
from agents.errors import Refusal
from agents.network import messages
from agents.robot import Robot
from experiments import run
from experiments.definition import standby as reserves
from experiments.definition.experiment import ChannelTable, Hybrid, LegTable, LinkChannelTable, Outage, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.consistency.whole import consistency_faults
from experiments.real_time.conductor.hot_changes import Spares
from tests.small import changed, small

BOT = RobotTable(kind="khepera4", start=[0.0, 0.0])
FLY = RobotTable(kind="crazyflie", start=[0.5, 0.5], hover=0.5)


def with_standby(**parts):
    robots = {"A": BOT, "B": changed(BOT, start=[0.5, 0.0]), "C": changed(FLY, standby=True)}
    return small(robots, {"A - B": 0.5, "A - C": 0.7, "C > B": 0.7}, duration_s=5.0, **parts)


def test_without_those_on_standby_nothing_names_them():
    whole = with_standby(
        timeline=[LegTable(at_s=1.0, robot="C", plan="hold")],
        architecture=Hybrid("hybrid", ["A", "C"]),
        channel=ChannelTable(
            links={"A > C": LinkChannelTable(loss=0.5), "A > B": LinkChannelTable(loss=0.1)},
            outages=[Outage(from_s=1.0, links=["A - C"]), Outage(from_s=2.0, robots=["B", "C"]), Outage(from_s=3.0)],
        ),
    )
    plan = reserves.without_standby(Plan(whole))
    made = plan.experiment
    assert list(made.robots) == ["A", "B"]
    assert made.formation.links == {"A - B": 0.5}
    assert not made.timeline
    assert list(made.channel.links) == ["A > B"]
    assert [(outage.from_s, outage.robots) for outage in made.channel.outages] == [(2.0, ["B"]), (3.0, [])]
    assert made.architecture == Hybrid("hybrid", ["A"])
    assert not list(consistency_faults(plan))
    assert not list(consistency_faults(Plan(with_standby(spares={"S": FLY, "T": BOT}, on_loss="replace"))))
    assert reserves.without_standby(plan) is plan


def test_virtual_time_flies_without_those_on_standby(tmp_path):
    file = tmp_path / "x.json"
    file.write_bytes(document.write_json(Plan(with_standby())))
    (trace,) = run.simulate(document.read(file)).traces.values()
    assert trace.robots == ("A", "B")


@pytest.mark.parametrize("standby", [True, False])
def test_nobody_waits_for_a_robot_on_standby(standby):
    case = with_standby()
    told = Plan(changed(case, robots={**case.robots, "C": changed(FLY, standby=standby)})).assignment("A")
    robot = Robot(told)
    assert robot.missing_neighbours() == ["B", "C"]
    place = next(place for place, link in enumerate(told.neighbours) if link.name == "B")
    robot.neighbours.mark_alive(place)
    robot.neighbours.receive(place, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0)
    state = BodyState(time=0.0, position=(0.0, 0.0, 0.0), yaw=0.0, velocity=(0.0, 0.0, 0.0), flying=False, battery=1.0)
    for tick in range(3):
        robot.transmit(0.01 * tick, state)
        robot.act(0.01 * tick)
    assert (robot.lifecycle.phase > 0) == standby
    assert robot.missing_neighbours() == ["C"]


def order(**more):
    return messages.RunOrder("replace", ["A"], **more)


def test_spare_brings_its_body_and_keeps_the_rest():
    spare = changed(BOT, start=[0.2, 0.3, 1.0], body="khepera4://192.0.2.1", avoids=False)
    spares = Spares(Plan(with_standby(spares={"F": FLY, "S": spare})))
    old = changed(BOT, ranges="world")
    robot, whose = spares.successor("A", old, order())
    assert whose == "S", "the first of its kind"
    assert (robot.body, robot.start, robot.avoids, robot.ranges) == (spare.body, spare.start, True, "body")
    spares.used["S"] = "A"
    with pytest.raises(Refusal, match="no spare khepera4 left"):
        spares.successor("A", old, order())
    robot, whose = spares.successor("A", old, order(body="twin", at=(0.5, 0.25), yaw=1.0))
    assert (robot.body, robot.start, whose) == ("twin", [0.5, 0.25, 1.0], None)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (order(spare="F"), "is a crazyflie and cannot be A"),
        (order(spare="G"), "no spare 'G'"),
        (order(spare="S", body="twin"), "leave --body or --with out"),
        (order(body="tello-twin"), "before the run only"),
        (order(body="nowhere://1"), "no 'nowhere'"),
        (order(body="world"), "into the world"),
        (order(body="twin", at=(99.0, 0.0)), "outside of the arena"),
        (order(body="twin", at=(float("nan"), 0.0)), "outside of the arena"),
        (order(body="twin", at=(0.0, 0.0), yaw=float("inf")), "outside of the arena"),
        (order(body="khepera4://192.0.2.1", at=(0.0, 0.0)), "only a twin"),
    ],
)
def test_what_cannot_take_over_a_name(asked, said):
    with pytest.raises(Refusal, match=said):
        Spares(Plan(with_standby(spares={"F": FLY, "S": BOT}))).successor("A", BOT, asked)
