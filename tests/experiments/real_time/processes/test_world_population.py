"""Who is in a world and where, and what a world believes; no process and no network."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.definition.experiment import Arena, Experiment, Robot, World
from experiments.real_time.processes.world_population import Population, Refused
from twins.scene import Obstacle

POST = Obstacle(radius=0.1, at=(1.5, 1.5))
CRATE = Obstacle(box=(0.4, 0.2), at=(-1.5, -1.0), yaw=math.pi / 2, mass=2.0)
FENCE = Obstacle(wall=[(-0.5, 0.0), (0.5, 0.0)], at=(0.0, -1.5))
SHELF = Obstacle(box=(0.5, 0.5), at=(1.5, -1.5), bottom=0.5)


def experiment(**robots: Robot) -> Experiment:
    return Experiment(
        title="a world",
        duration_s=10.0,
        arena=Arena(obstacles={"post": POST, "crate": CRATE, "fence": FENCE, "shelf": SHELF}),
        robots=robots
        or {
            "KH01": Robot(kind="khepera4", start=[0.0, 0.0], body="world"),
            "CF01": Robot(kind="crazyflie", start=[0.0, 1.0, 0.5], body="world", hover=0.6),
            "TB01": Robot(kind="turtlebot3", start=[1.0, 0.0]),
        },
    )


@pytest.fixture
def world() -> Population:
    return Population(experiment())


def row(world: Population, name: str) -> int:
    return world.names.index(name)


def at(world: Population, name: str) -> list[float]:
    return [round(value, 6) for value in world.state.true_position[row(world, name)].tolist()]


def go(world: Population, ticks: int, **setpoints: tuple[float, float, float, float]) -> None:
    for _ in range(ticks):
        given = np.full((len(world.names), 4), np.nan)
        rows = np.array([row(world, name) for name in setpoints], dtype=np.intp)
        for name, setpoint in setpoints.items():
            given[row(world, name)] = setpoint
        world.drive(given, rows)
        world.advance()


def test_robots_of_a_world_are_carried_and_the_others_are_mirrors(world: Population) -> None:
    assert world.names == ("KH01", "CF01", "TB01")
    assert world.carried.tolist() == [True, True, False]
    assert world.seen.tolist() == [True, True, False]
    assert at(world, "CF01") == [0.0, 1.0, 0.0]
    assert np.isnan(world.state.true_position[2]).all(), "nobody has said where it is"
    go(world, 100, KH01=(0.2, 0.0, 0.0, 0.0))
    assert world.time == pytest.approx(1.0)
    assert at(world, "KH01")[0] == pytest.approx(0.19, abs=0.011)


def test_who_asks_for_ranges_gets_sensors_without_being_carried() -> None:
    world = Population(
        experiment(
            TB01=Robot(kind="turtlebot3", start=[1.0, 0.0], ranges="world"),
            KH01=Robot(kind="khepera4", start=[0.0, 0.0]),
        )
    )
    assert world.carried.tolist() == [False, False]
    assert world.seen.tolist() == [True, False]


def test_those_who_stay_go_on_when_others_come_and_go(world: Population) -> None:
    world.takeoff(row(world, "CF01"), 0.6)
    go(world, 90, KH01=(0.2, 0.1, 0.0, 0.0))
    before, height = at(world, "KH01"), at(world, "CF01")[2]
    assert 0.05 < height < 0.5
    world.spawn_robot("KH02", "khepera4", (0.5, -0.5), 1.0)
    assert world.names == ("KH01", "CF01", "TB01", "KH02")
    assert at(world, "KH01") == before
    assert at(world, "CF01")[2] == pytest.approx(height, abs=1e-6)
    assert at(world, "KH02") == [0.5, -0.5, 0.0]
    go(world, 250)
    assert at(world, "CF01")[2] == pytest.approx(0.6, abs=0.01), "its climb goes on"
    world.remove("KH01")
    world.land(np.array([row(world, "CF01")]))
    go(world, 20)
    world.remove("TB01")
    go(world, 250)
    assert world.names == ("CF01", "KH02")
    assert at(world, "CF01") == [0.0, 1.0, 0.0]
    assert not world.body.engine.flying.any()
    world.spawn_robot("KH01", None, None, 0.0)
    assert at(world, "KH01") == [0.0, 0.0, 0.0], "a robot of the file comes back to its start"
    assert world.time == pytest.approx(6.1)


def test_reset_puts_back_and_leaves_in_the_air_what_flies(world: Population) -> None:
    world.takeoff(row(world, "CF01"), 0.6)
    go(world, 250)
    go(world, 100, CF01=(0.4, 1.2, 0.6, 0.0), KH01=(0.2, 0.0, 0.0, 0.0))
    assert at(world, "CF01")[0] > 0.3
    world.reset("KH01")
    assert at(world, "KH01") == [0.0, 0.0, 0.0]
    assert at(world, "CF01")[0] > 0.3
    world.reset(None)
    assert at(world, "CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)]
    assert world.state.true_yaw[1] == 0.5
    assert world.body.engine.flying.tolist()[:2] == [False, True]
    go(world, 50)
    assert at(world, "CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)], "it holds there"
    with pytest.raises(Refused, match="TB01 is only mirrored here"):
        world.reset("TB01")
    world.spawn_robot("KH02", "khepera4", (1.0, 1.0), 0.0)
    go(world, 200, KH01=(0.2, 0.0, 0.0, 0.0))
    world.put("KH02", (0.0, 0.0, 0.0), 0.0, flying=False)
    with pytest.raises(Refused, match="KH01 would overlap KH02 by 140 mm"):
        world.reset("KH01")


@pytest.mark.parametrize(
    ("name", "kind", "place", "why"),
    [
        ("KH01", None, None, "KH01 is in this world already; remove it first, or reset it"),
        ("KH02", None, (0.5, 0.5), "a new robot needs its kind and a place"),
        ("KH02", "roomba", (0.5, 0.5), "there is no kind of robot 'roomba'; known: crazyflie"),
        ("KH 2", "khepera4", (0.5, 0.5), "'KH 2' cannot be a name"),
        ("world", "khepera4", (0.5, 0.5), "'world' cannot be a name"),
        ("KH02", "khepera4", (0.1, 0.05), "KH02 would overlap KH01 by 28 mm"),
        ("KH02", "khepera4", (1.94, 0.0), "outside the arena, which is 4 by 4 m"),
        ("KH02", "khepera4", (math.nan, 0.0), "finite numbers"),
        ("KH02", "khepera4", (1.4, 1.4), "KH02 would overlap post by 29 mm"),
        ("KH02", "khepera4", (-1.5, -0.75), "KH02 would overlap crate by 20 mm"),
        ("KH02", "khepera4", (-1.35, -1.0), "KH02 would overlap crate by 20 mm"),
        ("KH02", "khepera4", (-1.5, -1.0), "KH02 would overlap crate by 170 mm"),
        ("KH02", "khepera4", (0.3, -1.45), "KH02 would overlap fence by 20 mm"),
        ("KH02", "khepera4", (0.55, -1.5), "KH02 would overlap fence by 20 mm"),
    ],
)
def test_who_cannot_come_in(
    world: Population, name: str, kind: str | None, place: tuple[float, float] | None, why: str
) -> None:
    with pytest.raises(Refused, match=why):
        world.spawn_robot(name, kind, place, 0.0)
    assert world.names == ("KH01", "CF01", "TB01")


def test_there_is_room_beside_over_and_under(world: Population) -> None:
    world.spawn_robot("KH02", "khepera4", (0.1401, 0.0), 0.0)
    world.spawn_robot("KH03", "khepera4", (1.5, -1.5), 0.0)  # the shelf hangs half a metre over it
    world.takeoff(row(world, "CF01"), 0.6)
    go(world, 250)
    world.spawn_robot("KH04", "khepera4", (0.0, 1.0), 0.0)
    assert at(world, "KH04") == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("name", "given", "why"),
    [
        ("post", {"radius": 0.1}, "there is something called post already"),
        ("KH01", {"radius": 0.1}, "there is something called KH01 already"),
        ("wall", {"radius": 0.1, "at": [1, 1]}, "'wall' cannot be a name"),
        ("box", {"radius": 0.1}, "box would overlap KH01"),
        ("box", {"radius": 0.1, "at": [1.95, 0]}, "out of the arena, which is 4 by 4 m"),
        ("box", {"box": [1.0, 1.0], "at": [1.4, 1.4], "yaw": 0.785}, "out of the arena"),
        ("box", {"at": [1, 1]}, "box is no obstacle: .*exactly one of box, radius and wall"),
        (
            "box",
            {"radius": -1.0, "at": [1, 1]},
            "box is no obstacle: 'radius' must be a number > 0, not -1.0",
        ),
        ("box", {"radius": 0.1, "at": [math.nan, 1]}, "a number is not finite"),
        ("box", {"radius": 0.1, "at": [1, 1], "plan": "dance"}, "box is no obstacle: no 'dance' among the planners"),
        ("box", {"radius": 0.1, "at": [1, 1], "colour": "red"}, "box is no obstacle: .*colour"),
    ],
)
def test_which_obstacle_cannot_stand(world: Population, name: str, given: dict[str, object], why: str) -> None:
    with pytest.raises(Refused, match=why):
        world.spawn_obstacle(name, given)
    assert list(world.obstacles()) == ["post", "crate", "fence", "shelf"]


def test_obstacles_come_and_go(world: Population) -> None:
    world.spawn_obstacle("lamp", {"radius": 0.2, "at": [0.0, 0.0], "bottom": 0.5})
    assert world.obstacles()["lamp"] == (0.0, 0.0, 0.0)
    world.remove("post")
    assert list(world.obstacles()) == ["crate", "fence", "shelf", "lamp"]
    assert world.obstacles()["crate"] == (-1.5, -1.0, pytest.approx(math.pi / 2, abs=1e-6))
    with pytest.raises(Refused, match=r"there is no 'lamb' in this world; did you mean 'lamp'\?"):
        world.remove("lamb")
    world.remove("KH01")
    world.remove("TB01")
    with pytest.raises(Refused, match="CF01 is the last robot of this world: end the world instead"):
        world.remove("CF01")


def test_what_moves_by_a_plan_begins_with_the_run_and_goes_on_when_somebody_comes() -> None:
    belt = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.5})
    given = experiment()
    arena = msgspec.structs.replace(given.arena, obstacles={"belt": belt})
    world = Population(msgspec.structs.replace(given, arena=arena))
    go(world, 100)
    assert world.obstacles()["belt"] == (0.0, -1.0, 0.0)
    world.begin(world.time + 0.5)
    go(world, 150)
    assert world.obstacles()["belt"][0] == pytest.approx(0.5, abs=0.05)
    moved = world.obstacles()["belt"][0]
    world.spawn_robot("KH02", "khepera4", (-1.0, 1.0), 0.0)
    go(world, 20)
    assert world.obstacles()["belt"][0] == pytest.approx(moved + 0.1, abs=0.03)


def test_contacts_have_names() -> None:
    given = experiment(
        KH01=Robot(kind="khepera4", start=[0.0, 0.0], body="world"),
        KH02=Robot(kind="khepera4", start=[0.3, 0.0, math.pi], body="world"),
        KH03=Robot(kind="khepera4", start=[1.8, 0.0], body="world"),
        KH04=Robot(kind="khepera4", start=[1.5, 1.2, math.pi / 2], body="world"),
    )
    world = Population(msgspec.structs.replace(given, world=World(engine="pymunk")))
    found = []
    for _ in range(200):
        go(world, 1, **dict.fromkeys(world.names, (0.2, 0.0, 0.0, 0.0)))
        found += world.meetings()
    pairs = {frozenset((meeting.first, meeting.second)) for meeting in found}
    assert pairs == {frozenset(("KH01", "KH02")), frozenset(("KH03", "wall")), frozenset(("KH04", "post"))}
    assert all(meeting.impulse > 0.0 and meeting.overlap < 1e-3 for meeting in found)


number = st.floats(allow_nan=True, allow_infinity=True)
place = st.tuples(number, number) | st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


@pytest.fixture(scope="module")
def busy() -> Population:
    return Population(experiment())


@settings(max_examples=100)
@given(st.text(max_size=4) | st.just("KH09"), place, number)
def test_whatever_is_ordered_ends_well(busy: Population, name: str, where: tuple[float, float], yaw: float) -> None:
    """Robots that were let in do not overlap; everything else is `Refused`."""
    try:
        busy.spawn_robot(name, "khepera4", where, yaw)
    except Refused:
        return
    there = busy.state.true_position[busy.carried, :2]
    apart = np.linalg.norm(there[:, None] - there, axis=2) + 10.0 * np.eye(len(there))
    assert apart.min() > 0.065 + 0.07 - 1e-9
    assert (np.abs(there) < 2.0).all()
    busy.remove(name)


def test_wheels_stop_without_commands_only_with_a_watchdog(world: Population) -> None:
    flying = row(world, "CF01")
    assert world.hold_s[flying] == 0.5
    assert world.hold_s[row(world, "KH01")] == np.inf
    watched = msgspec.structs.replace(
        world._experiment, world=msgspec.structs.replace(world._experiment.world, wheels_stop_s=0.7)
    )
    assert Population(watched).hold_s[row(world, "KH01")] == 0.7
    go(world, 10, KH01=(0.2, 0.0, 0.0, 0.0))
    go(world, 300)
    assert at(world, "KH01")[0] > 0.5, "it drives on, as the real one"
