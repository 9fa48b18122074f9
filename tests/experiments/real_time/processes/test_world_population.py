"""Robots of a world, their places, and accepted input; no process and no network."""

import math

import numpy as np
import pytest

from agents.errors import Refusal
from agents.vectors import NO_SETPOINT
from experiments.definition.experiment import Arena, RobotTable, WorldTable
from experiments.definition.plan import Plan
from experiments.real_time.processes.world_population import WorldBodies
from tests.small import small
from twins.scene import Obstacle

OBSTACLES = {
    "post": Obstacle(radius=0.1, at=(1.5, 1.5)),
    "crate": Obstacle(box=(0.4, 0.2), at=(-1.5, -1.0), yaw=math.pi / 2, mass=0.2),
    "fence": Obstacle(wall=[(-0.5, 0.0), (0.5, 0.0)], at=(0.0, -1.5)),
    "shelf": Obstacle(box=(0.5, 0.5), at=(1.5, -1.5), bottom=0.5),
}
FORWARD = (0.2, 0.0, 0.0, 0.0)


def carried(x, y, yaw=0.0):
    return RobotTable(kind="khepera4", start=[x, y, yaw], body="world")


ROBOTS = {
    "KH01": carried(0.0, 0.0),
    "CF01": RobotTable(kind="crazyflie", start=[0.0, 1.0, 0.5], body="world", hover=0.6),
    "TB01": RobotTable(kind="turtlebot3", start=[1.0, 0.0]),
}


class World(WorldBodies):
    """A world with four obstacles, addressed by name."""

    def __init__(self, robots=ROBOTS, obstacles=OBSTACLES, **world):
        super().__init__(Plan(small(robots, arena=Arena(obstacles=obstacles), world=WorldTable(**world))))

    def row(self, name):
        return self.names.index(name)

    def at(self, name):
        return [round(value, 6) for value in self.states[self.row(name)].true_position]

    def go(self, ticks, **setpoints):
        for _ in range(ticks):
            self.body.command([setpoints.get(name, NO_SETPOINT) for name in self.names])
            self.advance()


def test_world_carries_its_robots_and_mirrors_others():
    world = World()
    assert world.names == ("KH01", "CF01", "TB01")
    assert world.carried == world.seen == (True, True, False)
    assert world.at("CF01") == [0.0, 1.0, 0.0]
    assert np.isnan(world.states[2].true_position).all(), "nobody has said where it is"
    world.go(100, KH01=FORWARD)
    assert world.time == pytest.approx(1.0)
    assert world.at("KH01")[0] == pytest.approx(0.19, abs=0.011)
    seeing = RobotTable(kind="turtlebot3", start=[1.0, 0.0], ranges="world")
    world = World({"TB01": seeing, "KH01": RobotTable(kind="khepera4", start=[0.0, 0.0])})
    assert (world.carried, world.seen) == ((False, False), (True, False)), "a mirrored one may ask for ranges"


def test_reset_puts_back_and_leaves_in_the_air():
    world = World()
    world.takeoff(world.row("CF01"), 0.6)
    world.go(250)
    world.go(100, CF01=(0.4, 1.2, 0.6, 0.0), KH01=FORWARD)
    world.reset("KH01")
    assert world.at("KH01") == [0.0, 0.0, 0.0]
    assert world.at("CF01")[0] > 0.3
    world.reset(None)
    assert world.states[1].true_yaw == 0.5
    assert [state.flying for state in world.states[:2]] == [False, True]
    for ticks in (0, 50):
        world.go(ticks)
        assert world.at("CF01") == [0.0, 1.0, pytest.approx(0.6, abs=0.01)], "it holds there"


def test_reset_that_cannot_be_is_refused():
    cart = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [0.0, 1.0], "speed": 0.5})
    world = World(obstacles={"cart": cart})
    world.begin(0.0)
    world.go(300)
    for name, reason in (
        ("TB01", "TB01 is only mirrored here"),
        ("KH02", r"there is no 'KH02' in this world; did you mean 'KH01'\?"),
        ("KH01", "KH01 would overlap cart by 170 mm: reset all"),
    ):
        with pytest.raises(Refusal, match=reason):
            world.reset(name)
    world = World()
    world.go(200, KH01=FORWARD)
    world.put("CF01", (0.0, 0.0, 0.0), 0.0, flying=False)
    with pytest.raises(Refusal, match=r"KH01 would overlap CF01 by \d+ mm: move that first"):
        world.reset("KH01")


def test_reset_puts_back_pushed_obstacles():
    world = World({"KH01": carried(-1.0, -1.0, math.pi)}, {"crate": OBSTACLES["crate"]}, engine="pymunk")
    world.go(400, KH01=FORWARD)
    assert world.obstacles()["crate"][0] < -1.55
    world.reset(None)
    assert world.obstacles()["crate"] == (-1.5, -1.0, pytest.approx(math.pi / 2, abs=1e-6))
    assert world.at("KH01") == [-1.0, -1.0, 0.0]
    assert world.time == pytest.approx(4.0)


def test_planned_obstacles_move_from_the_start():
    belt = Obstacle(box=(0.2, 0.2), at=(0.0, -1.0), plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.5})
    world = World(obstacles={"belt": belt})
    world.go(100)
    assert world.obstacles()["belt"] == (0.0, -1.0, 0.0)
    world.begin(world.time + 0.5)
    world.go(150)
    moved = world.obstacles()["belt"][0]
    assert moved == pytest.approx(0.5, abs=0.05)
    world.reset(None)
    world.go(20)
    assert world.obstacles()["belt"][0] == pytest.approx(moved + 0.1, abs=0.03)


def test_contacts_have_names():
    places = [(0.0, 0.0), (0.3, 0.0, math.pi), (1.8, 0.0), (1.5, 1.2, math.pi / 2)]
    world = World({f"KH0{number}": carried(*place) for number, place in enumerate(places, 1)}, engine="pymunk")
    found = []
    for _ in range(200):
        world.go(1, **dict.fromkeys(world.names, FORWARD))
        found += world.meetings(0.0)
    pairs = {frozenset((meeting.first, meeting.second)) for meeting in found}
    assert pairs == {frozenset(("KH01", "KH02")), frozenset(("KH03", "wall")), frozenset(("KH04", "post"))}
    assert all(meeting.impulse > 0.0 and meeting.overlap < 1e-3 for meeting in found)


def test_wheels_stop_with_a_watchdog_alone():
    world = World()
    assert (world.hold_s[world.row("CF01")], world.hold_s[world.row("KH01")]) == (0.5, np.inf)
    watched = World(wheel_watchdog_s=0.7)
    assert watched.hold_s[watched.row("KH01")] == 0.7
    world.go(10, KH01=FORWARD)
    world.go(300)
    assert world.at("KH01")[0] > 0.5, "it drives on, as the real one"
