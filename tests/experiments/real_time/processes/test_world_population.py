"""Who is in a world and where, and what a world believes; no process and no network."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from agents.errors import Refusal
from agents.vectors import NO_SETPOINT
from experiments.definition.experiment import Arena, Experiment, RobotTable, WorldTable
from experiments.definition.plan import Plan
from experiments.real_time.processes.world_population import WorldBodies
from twins.scene import Obstacle

POST = Obstacle(radius=0.1, at=(1.5, 1.5))
CRATE = Obstacle(box=(0.4, 0.2), at=(-1.5, -1.0), yaw=math.pi / 2, mass=2.0)
FENCE = Obstacle(wall=[(-0.5, 0.0), (0.5, 0.0)], at=(0.0, -1.5))
SHELF = Obstacle(box=(0.5, 0.5), at=(1.5, -1.5), bottom=0.5)


def experiment(**robots: RobotTable) -> Experiment:
    return Experiment(
        title="a world",
        duration_s=10.0,
        arena=Arena(obstacles={"post": POST, "crate": CRATE, "fence": FENCE, "shelf": SHELF}),
        robots=robots
        or {
            "KH01": RobotTable(kind="khepera4", start=[0.0, 0.0], body="world"),
            "CF01": RobotTable(kind="crazyflie", start=[0.0, 1.0, 0.5], body="world", hover=0.6),
            "TB01": RobotTable(kind="turtlebot3", start=[1.0, 0.0]),
        },
    )


@pytest.fixture
def world() -> WorldBodies:
    return WorldBodies(Plan(experiment()))


def row(world: WorldBodies, name: str) -> int:
    return world.names.index(name)


def at(world: WorldBodies, name: str) -> list[float]:
    return [round(value, 6) for value in world.states[row(world, name)].true_position]


def go(world: WorldBodies, ticks: int, **setpoints: tuple[float, float, float, float]) -> None:
    for _ in range(ticks):
        world.body.command([setpoints.get(name, NO_SETPOINT) for name in world.names])
        world.advance()


def test_world_carries_its_robots_and_mirrors_others(world: WorldBodies) -> None:
    assert world.names == ("KH01", "CF01", "TB01")
    assert world.carried == (True, True, False)
    assert world.seen == (True, True, False)
    assert at(world, "CF01") == [0.0, 1.0, 0.0]
    assert np.isnan(world.states[2].true_position).all(), "nobody has said where it is"
    go(world, 100, KH01=(0.2, 0.0, 0.0, 0.0))
    assert world.time == pytest.approx(1.0)
    assert at(world, "KH01")[0] == pytest.approx(0.19, abs=0.011)


def test_mirrored_robot_may_ask_for_ranges() -> None:
    world = WorldBodies(
        Plan(
            experiment(
                TB01=RobotTable(kind="turtlebot3", start=[1.0, 0.0], ranges="world"),
                KH01=RobotTable(kind="khepera4", start=[0.0, 0.0]),
            )
        )
    )
    assert world.carried == (False, False)
    assert world.seen == (True, False)


def test_reset_puts_back_and_leaves_in_the_air(world: WorldBodies) -> None:
    world.takeoff(row(world, "CF01"), 0.6)
    go(world, 250)
    go(world, 100, CF01=(0.4, 1.2, 0.6, 0.0), KH01=(0.2, 0.0, 0.0, 0.0))
    assert at(world, "CF01")[0] > 0.3
    world.reset("KH01")
    assert at(world, "KH01") == [0.0, 0.0, 0.0]
    assert at(world, "CF01")[0] > 0.3
    world.reset(None)
    assert at(world, "CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)]
    assert world.states[1].true_yaw == 0.5
    assert [state.flying for state in world.states[:2]] == [False, True]
    go(world, 50)
    assert at(world, "CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)], "it holds there"
    with pytest.raises(Refusal, match="TB01 is only mirrored here"):
        world.reset("TB01")
    go(world, 200, KH01=(0.2, 0.0, 0.0, 0.0))
    world.put("CF01", (0.0, 0.0, 0.0), 0.0, flying=False)
    with pytest.raises(Refusal, match=r"KH01 would overlap CF01 by \d+ mm: move that first"):
        world.reset("KH01")
    with pytest.raises(Refusal, match=r"there is no 'KH02' in this world; did you mean 'KH01'\?"):
        world.reset("KH02")


def test_reset_puts_back_pushed_obstacles() -> None:
    given = experiment(KH01=RobotTable(kind="khepera4", start=[-1.0, -1.0, math.pi], body="world"))
    arena = msgspec.structs.replace(given.arena, obstacles={"crate": msgspec.structs.replace(CRATE, mass=0.2)})
    world = WorldBodies(Plan(msgspec.structs.replace(given, arena=arena, world=WorldTable(engine="pymunk"))))
    go(world, 400, KH01=(0.2, 0.0, 0.0, 0.0))
    assert world.obstacles()["crate"][0] < -1.55
    world.reset(None)
    assert world.obstacles()["crate"] == (-1.5, -1.0, pytest.approx(math.pi / 2, abs=1e-6))
    assert at(world, "KH01") == [-1.0, -1.0, 0.0]
    assert world.time == pytest.approx(4.0)


def test_nothing_is_put_back_into_an_obstacle() -> None:
    cart = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [0.0, 1.0], "speed": 0.5})
    given = experiment()
    world = WorldBodies(
        Plan(msgspec.structs.replace(given, arena=msgspec.structs.replace(given.arena, obstacles={"cart": cart})))
    )
    world.begin(0.0)
    go(world, 300)
    with pytest.raises(Refusal, match="KH01 would overlap cart by 170 mm: reset all"):
        world.reset("KH01")


def test_planned_obstacles_move_from_the_start() -> None:
    belt = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.5})
    given = experiment()
    arena = msgspec.structs.replace(given.arena, obstacles={"belt": belt})
    world = WorldBodies(Plan(msgspec.structs.replace(given, arena=arena)))
    go(world, 100)
    assert world.obstacles()["belt"] == (0.0, -1.0, 0.0)
    world.begin(world.time + 0.5)
    go(world, 150)
    assert world.obstacles()["belt"][0] == pytest.approx(0.5, abs=0.05)
    moved = world.obstacles()["belt"][0]
    world.reset(None)
    go(world, 20)
    assert world.obstacles()["belt"][0] == pytest.approx(moved + 0.1, abs=0.03)


def test_contacts_have_names() -> None:
    given = experiment(
        KH01=RobotTable(kind="khepera4", start=[0.0, 0.0], body="world"),
        KH02=RobotTable(kind="khepera4", start=[0.3, 0.0, math.pi], body="world"),
        KH03=RobotTable(kind="khepera4", start=[1.8, 0.0], body="world"),
        KH04=RobotTable(kind="khepera4", start=[1.5, 1.2, math.pi / 2], body="world"),
    )
    world = WorldBodies(Plan(msgspec.structs.replace(given, world=WorldTable(engine="pymunk"))))
    found = []
    for _ in range(200):
        go(world, 1, **dict.fromkeys(world.names, (0.2, 0.0, 0.0, 0.0)))
        found += world.meetings()
    pairs = {frozenset((meeting.first, meeting.second)) for meeting in found}
    assert pairs == {frozenset(("KH01", "KH02")), frozenset(("KH03", "wall")), frozenset(("KH04", "post"))}
    assert all(meeting.impulse > 0.0 and meeting.overlap < 1e-3 for meeting in found)


def test_wheels_stop_with_a_watchdog_alone(world: WorldBodies) -> None:
    flying = row(world, "CF01")
    assert world.hold_s[flying] == 0.5
    assert world.hold_s[row(world, "KH01")] == np.inf
    watched = experiment()
    watched = msgspec.structs.replace(watched, world=msgspec.structs.replace(watched.world, wheel_watchdog_s=0.7))
    assert WorldBodies(Plan(watched)).hold_s[row(world, "KH01")] == 0.7
    go(world, 10, KH01=(0.2, 0.0, 0.0, 0.0))
    go(world, 300)
    assert at(world, "KH01")[0] > 0.5, "it drives on, as the real one"
