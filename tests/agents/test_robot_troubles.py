"""Robots whose position, body or neighbours fail: each ends stopped or landed, and no drone comes up again."""

import random
from functools import partial
from itertools import cycle, product
from math import dist, inf, isfinite, isnan, nan

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, RUNNING
from agents.network.messages import Order
from agents.plugins import registry
from agents.plugins.laws import Distance
from agents.robot import Robot
from agents.runtime.orders import carry_out
from agents.safety.hazards import Cause
from agents.vectors import NO_SETPOINT, UNKNOWN
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.file.document import load
from tests.agents.bench import Swarm, drone
from tests.cases import mostly_slow, nightly
from tests.small import pair, small

SLOW = partial(pytest.param, marks=pytest.mark.slow)

STILL = (0.0, 0.0, 0.0, 0.0)


def put(place):
    return lambda state: setattr(state, "position", place)


def frozen(time):
    return lambda state: setattr(state, "time", time)


def shifted(x, y=0.0):
    return lambda state: setattr(state, "position", (state.position[0] + x, state.position[1] + y, state.position[2]))


LOST = {
    "nowhere": put(UNKNOWN),
    "half": lambda state: setattr(state, "position", (nan, *state.position[1:])),
    "no heading": lambda state: setattr(state, "yaw", nan),
}


def causes(swarm, name):
    return {incident.cause for incident in swarm.robot(name).hazards.incidents}


def ended(swarm, name):
    return swarm.phase(name), swarm.robot(name).lifecycle.reason


def flying(moment):
    """A drone that climbs, waits for its start, runs, or has begun to land."""
    if moment == "waiting":
        return drone().until(AIRBORNE)
    if moment != "climbing":
        swarm = drone().running().run(0.5)
        if moment == "landing":
            swarm.robot("F").lifecycle.land("by a test")
            swarm.run(0.2)
        return swarm
    swarm = drone().run(0.02)
    assert swarm.robot("F").lifecycle.takeoff() == ""
    return swarm.run(0.5)


@pytest.mark.parametrize("what", ["old", "ahead", *LOST])
@pytest.mark.parametrize("moment", ["climbing", "waiting", "running"])
def test_blind_drone_lands(what, moment):
    swarm = flying(moment)
    grace = 81 if what == "old" else 31  # 0.5 s until it is old, 0.3 s of holding
    spoils = {"old": frozen(swarm.t - 1e-9), "ahead": frozen(swarm.t + 100.0)}  # these would never become old
    swarm.spoil("F", {**spoils, **LOST}[what])
    for _ in range(grace):
        assert swarm.phase("F") < LANDING
        swarm.step()
    assert ended(swarm, "F") == (LANDING, "its own position is lost")
    assert swarm.last("F", "setpoint") == pytest.approx(NO_SETPOINT, nan_ok=True)
    assert swarm.until(DONE).last("F", "truth")[2] == 0.0


def test_followers_of_blind_wheels_stop():
    robots = {name: RobotTable(kind="khepera4", start=[x, 0.0]) for name, x in (("A", -1.5), ("B", -1.0))}
    shape = Formation(links={"B > A": 0.5})
    swarm = Swarm(pair(robots=robots, formation=shape, prediction={"kind": "constant-velocity"})).running()
    assert swarm.robot("B").go((1.5, 0.0), swarm.t) == ""
    swarm.run(2.5).spoil("B", LOST["nowhere"])
    swarm.run(20.0)
    assert dist(swarm.last("A", "truth"), swarm.last("B", "truth")) > 0.4


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (shifted(0.5, 0.3), "it jumped by 0.58 m"),
        (lambda state: setattr(state, "yaw", state.yaw + 1.2), "its yaw jumped by 1.2"),
    ],
    ids=["place", "yaw"],
)
def test_wheels_that_jumped_hold_until_started(change, text):
    swarm = Swarm(pair()).running().run(0.5)
    swarm.spoil("A", change)
    begin = swarm.run(0.5).tick - 45
    (incident,) = [each for each in swarm.robot("A").hazards.incidents if text in each.text]
    assert incident.cause == Cause.POSITION
    assert (swarm.phase("A"), swarm.last("A", "setpoint")) == (RUNNING, STILL)
    assert not [tick for tick, name in swarm.sent if name == "A" and tick > begin]  # it leads nobody astray
    assert not swarm.robot("A").resume()
    assert any(swarm.run(1.0).last("A", "setpoint"))


def jump(swarm, name, lasts_s, off=1.0):
    """The measured position of a robot is `off` [m] for a time."""
    begin, change = swarm.t, shifted(0.0, off)
    swarm.spoil(name, lambda state: change(state) if swarm.t < begin + lasts_s else None)


@pytest.mark.parametrize("off", [4.0, 1e5])
@pytest.mark.parametrize("begins", ["climbing", "running", "landing"])
def test_refused_far_position_cuts_no_motors(begins, off):
    swarm = flying(begins)
    jump(swarm, "F", inf, off)
    while swarm.phase("F") != DONE:
        swarm.robot("F").resume()  # an operator who sees it stand
        swarm.step()
        assert isnan(swarm.robot("F").now.position[0])
        assert Cause.FAR_OUTSIDE not in causes(swarm, "F")
    assert swarm.last("F", "truth")[2] < 0.05  # it has landed


def test_start_order_confirms_no_jump_in_the_air():
    swarm = flying("waiting")
    robot, (x, y, z) = swarm.robot("F"), swarm.last("F", "position")
    for t, off in ((0.0, 0.0), (0.01, 1.5), (0.02, 0.0)):  # measured from outside
        assert robot.believes(swarm.t + t, (x + off, y, z)) == (off == 0.0)
    assert isnan(robot.believed_yaw(swarm.t, nan))
    jump(swarm, "F", inf)
    swarm.run(0.1)
    assert carry_out(robot, Order("start", at=swarm.t + 0.2), swarm.t, 0.0) == ("", None)
    swarm.step()
    assert isnan(robot.now.position[0])


class Mad(Distance, frozen=True):
    """Wants nothing that is a number of neighbours that are near."""

    def pull(self, apart, link):
        return (nan if abs(apart[0]) < 0.7 else 0.1 * -apart[0], 0.0, 0.0)


@pytest.mark.parametrize("kind", ["khepera4", "crazyflie", "tello"])
def test_law_that_wants_nonsense_is_stopped(kind, monkeypatch):
    monkeypatch.setattr(Plan, "law", Mad())
    hover = None if kind == "khepera4" else 0.6
    robots = {name: RobotTable(kind=kind, start=[x, 0.0], hover=hover) for name, x in (("A", -0.4), ("B", 0.4))}
    swarm = Swarm(pair(robots=robots)).running().run(12.0)
    for name in "AB":
        assert all(isfinite(each) or isnan(each) for setpoint in swarm.column(name, "setpoint") for each in setpoint)
        assert Cause.SETPOINT in causes(swarm, name)
        assert swarm.phase(name) >= LANDING or swarm.last(name, "setpoint")[:2] == (0.0, 0.0)
    near = Swarm(small({"A": "khepera4", "B": "khepera4"}, {"A - B": 0.5})).run(0.2)  # known before take-off
    assert ended(near, "A") == (IDLE, "its law wants something that is not finite")
    assert near.robot("A").lifecycle.takeoff()


def trouble(rng, swarm, name):
    robot = swarm.robot(name)
    x, y, z = (rng.uniform(-3.0, 3.0) for _ in range(3))
    return rng.choice([
        lambda: swarm.spoil(name, put((x, y, z))),
        lambda: swarm.spoil(name, rng.choice(list(LOST.values()))),
        lambda: swarm.spoil(name, frozen(swarm.t + rng.choice([0.0, 50.0]))),
        lambda: swarm.spoil(name, shifted(x, y)),
        lambda: swarm.spoil(name, None),
        lambda: swarm.spoil(name, lambda state: setattr(state, "velocity", (x * 9.0, nan, z))),
        lambda: swarm.lose(rng.choice([each for each in swarm.names if each != name]), name),
        lambda: swarm.find(rng.choice([each for each in swarm.names if each != name]), name),
        lambda: setattr(robot.health, "offline_since", swarm.t),
        robot.hold, robot.resume, robot.lifecycle.takeoff, lambda: robot.start(swarm.t),
        lambda: robot.lifecycle.land("told to"), lambda: robot.lifecycle.stop("told to"),
    ])  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1, *map(SLOW, range(2, 5)), *map(nightly, range(5, 12))])
def test_whatever_happens_no_robot_comes_up_again(seed):
    robots = {
        name: RobotTable(kind=kind, start=start, hover=hover)
        for name, kind, start, hover in (
            ("F", "crazyflie", [0.0, 0.0], 0.6), ("T", "tello", [0.6, 0.0], 0.8), ("K", "khepera4", [0.0, 0.7], None),
        )
    }  # fmt: skip
    links, barrier = {"F - T": 0.7, "K - F": 0.8, "K - T": 0.9}, {"kind": "barrier", "hears": "all"}
    rng, swarm = random.Random(seed), Swarm(small(robots, links, duration_s=60.0, avoidance=barrier))
    swarm.running().run(1.0)
    for _ in range(25):
        trouble(rng, swarm, rng.choice(swarm.names))()
        swarm.run(rng.uniform(0.05, 0.8))
    for name in swarm.names:
        swarm.robot(name).lifecycle.land("the end")
    swarm.until(DONE, most_s=40.0)
    for name in swarm.names:
        phases, setpoints = swarm.column(name, "phase"), swarm.column(name, "setpoint")
        assert phases == sorted(phases)
        down = phases.index(DONE)
        heights = [place[2] for place in swarm.column(name, "truth", down)]
        assert heights == sorted(heights, reverse=True)
        assert all(not isfinite(each) or abs(each) < 50.0 for setpoint in setpoints for each in setpoint)
        assert all(isnan(setpoint[0]) or not any(setpoint) for setpoint in setpoints[down:])


ODD = (nan, inf, -inf, 0.0, -0.0, 1e308, -1e308, 1e-308, 5e-324, 1e154, -1e154, 1e6, -1e6)


class Nonsense:
    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self._share = self.random.choice((0.0, 0.02, 0.3))

    def number(self, size: float = 1.0) -> float:
        return self.random.choice(ODD) if self.happens(self._share) else self.random.uniform(-size, size)

    def numbers(self, count: int, size: float = 1.0) -> tuple[float, ...]:
        return tuple(self.number(size) for _ in range(count))

    def happens(self, share: float) -> bool:
        return self.random.random() < share

    def state(self, t: float, *, flies: bool) -> BodyState:
        state = BodyState(
            t + self.number(0.02), self.numbers(3, 1.5), self.numbers(3, 0.5), self.number(3.0),
            battery=self.number(), flying=flies and self.happens(0.7), attitude=self.numbers(4),
            ahead=self.number(0.1), received=t - self.number(0.1),
        )  # fmt: skip
        if self.happens(0.1):
            state.scan = RangeScan(t - self.number(0.1), *(self.numbers(5, size) for size in (3.0, 0.3, 2.0)))
        return state


def disturb(robot: Robot, t: float, some: Nonsense) -> None:
    neighbours = robot.neighbours
    for k in range(len(neighbours.all)):
        if some.happens(0.3):
            place, velocity = (tuple(some.random.uniform(-2.0, 2.0) for _ in range(3)) for _ in range(2))
            neighbours.receive(k, place, velocity, t - some.random.uniform(0.0, 0.1), t)
        if some.happens(0.006):
            neighbours.mark_alive(k)
        if some.happens(0.004):
            neighbours.mark_lost(k, t)
    for share, order in (
        (0.02, robot.lifecycle.takeoff), (0.03, lambda: robot.start(t + 0.05, t)), (0.005, robot.hold),
        (0.005, robot.resume), (0.01, lambda: robot.go(some.numbers(2), t)),
        (0.1, lambda: robot.believes(t - some.number(0.1), some.numbers(3))),
        (0.1, lambda: robot.believed_yaw(t, some.number(3.0))),
    ):  # fmt: skip
        if some.happens(share):
            order()
    if robot.guidance is not None and some.happens(0.2):
        robot.guidance.receive(some.numbers(3), some.number(3.0), t)


def keeps_limits(robot: Robot) -> bool:
    """Whether the setpoint is whole or none, and within what the kind can and the arena allows."""
    kind, limits, setpoint = robot.assignment.kind, robot.assignment.limits, robot.setpoint
    if not any(map(isfinite, setpoint)):
        return True
    fits = abs(setpoint[0]) <= kind.speed + 1e-9
    if kind.takes == "position":
        inside = [low <= x <= high for low, x, high in zip(limits.low, setpoint, limits.high, strict=False)]
        fits = all(inside) or not robot.now.sound
    return fits and all(map(isfinite, setpoint))


OTHERS = ("obstacle-course", "convoy", "architectures")
CHOICE = [name for name in registry.names(registry.TRIGGERS) if not registry.struct(registry.TRIGGERS, name).FILES]
DAILY = [*zip(cycle(OTHERS), CHOICE, strict=False)]


@pytest.mark.parametrize(
    ("name", "trigger"),
    [
        *mostly_slow(product(["robotic-park"], CHOICE), 3),
        *(SLOW(*row) if row in DAILY else nightly(*row) for row in product(OTHERS, CHOICE)),
    ],
)
def test_nonsense_raises_nothing(name, trigger):
    for number, given in enumerate(load(name).cases().values()):
        plan = given.changed(trigger={"kind": trigger})
        for row, robot_name in enumerate(plan.names[:4]):
            some, robot, t = Nonsense(hash((number, row)) & 0xFFFF), Robot(plan.assignment(robot_name)), 0.0
            for tick in range(150):
                t += 0.01 if some.happens(0.99) else some.random.choice((0.5, 3.0))
                disturb(robot, t, some)
                if tick == 20:
                    robot.lifecycle.phase = max(robot.lifecycle.phase, AIRBORNE)
                robot.transmit(t, some.state(t, flies=robot.assignment.kind.flies))
                robot.act(t)
                assert keeps_limits(robot), (robot_name, tick, robot.setpoint)
