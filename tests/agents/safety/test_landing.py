"""Where drones come down: not on robots that they know to be below; and where robots stop: before walls."""

import random
from itertools import combinations
from math import dist, hypot, inf, isfinite, nan
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState, Disturbance
from agents.body.kinds import KINDS
from agents.body.limits import Limits
from agents.decision.lifecycle import DONE, RUNNING
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.situation import ProcessHealth, Situation
from agents.plugins.predictors import HOLD
from agents.safety.hazards import Cause
from agents.safety.landing import NEAR, PATIENCE_S, ROOM, Landing
from agents.safety.setpoint_filter import SetpointFilter
from agents.vectors import clamp
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from experiments.definition.experiment import LegTable, RobotTable
from tests.agents.bench import Swarm
from tests.cases import for_each, mostly_slow
from tests.small import small

DT, SINKS = 0.01, 0.4  # [s], [m/s]
SCENE = (KHEPERA4, KHEPERA4, TURTLEBOT3, CRAZYFLIE, CRAZYFLIE, TELLO)


class Lander:
    """Robot that goes where it is sent, and sinks when it lands."""

    def __init__(self, number, kinds, position, limits, *, linked):
        self.kind, self.position, self.velocity = kinds[number], tuple(position), (0.0, 0.0, 0.0)
        self.landing = Landing(SimpleNamespace(kind=self.kind, limits=limits, predictor=HOLD))
        senders = [other for other in range(len(kinds)) if linked and other != number]
        incoming = [Incoming(other, f"R{other}", kinds[other], 1.0) for other in senders]
        self.neighbours, self.health = Neighbours(incoming, 1.0), ProcessHealth()
        for link in range(len(incoming)):
            self.neighbours.mark_alive(link)
        self.filter, self.now = SetpointFilter(self.kind, limits), Situation()
        self.lands = self.ordered = self.kind.flies  # it is landing; and must begin to
        self.sinks_at = inf

    def decide(self, t, lag):
        self.now.state = BodyState(t - lag, self.position, self.velocity, 0.0, flying=self.kind.flies and self.lands)
        self.now.begin(t)
        self.filter.judge(self.now)
        if self.ordered or self.landing.aside:
            ordered, self.ordered = self.ordered, False
            if self.landing.filter_land(self.now, self.neighbours, self.health, ordered=ordered, landing=self.lands):
                self.sinks_at = t

    def move(self):
        target, sinking = self.landing.place if self.landing.aside else self.position, self.sinks_at < inf
        wanted = [clamp(2.0 * (to - here), -0.3, 0.3) for to, here in zip(target, self.position, strict=True)]
        if sinking and self.lands:
            wanted[2] = -SINKS
        self.velocity = tuple(v + (w - v) * DT / 0.1 for v, w in zip(self.velocity, wanted, strict=True))
        x, y, z = self.position = tuple(p + DT * v for p, v in zip(self.position, self.velocity, strict=True))
        if sinking and z <= 0.0:
            self.position, self.velocity, self.lands = (x, y, 0.0), (0.0, 0.0, 0.0), False


class Bench:
    """Robots anywhere, of whom all receive all, or none."""

    def __init__(self, kinds, positions, *, linked=True, arena=(6.0, 6.0, 2.0)):
        x, y, z = arena
        limits = Limits(low=(-x / 2, -y / 2, 0.0), high=(x / 2, y / 2, z))
        self.robots = [Lander(k, kinds, position, limits, linked=linked) for k, position in enumerate(positions)]
        self.t, self.lag, self.silent = 0.0, 0.0, False

    def step(self):
        for robot in self.robots:
            for link, sender in enumerate(robot.neighbours.all):
                other = self.robots[sender.sender]
                if not self.silent:
                    robot.neighbours.receive(link, other.position, other.velocity, self.t, self.t)
        for robot in self.robots:
            robot.decide(self.t, self.lag)
        for robot in self.robots:
            robot.move()
        self.t += DT
        return self

    def until_down(self):
        while any(robot.lands for robot in self.robots):
            assert self.step().gap() > 0.0, f"at {self.t:.2f} s"
            assert self.t < 15.0

    def gap(self):
        """The least distance of two surfaces, of pairs that are beside each other."""
        least = inf
        for pair in combinations(self.robots, 2):
            low, high = sorted(pair, key=lambda robot: robot.position[2])
            if high.position[2] < low.position[2] + low.kind.height:
                least = min(least, dist(low.position[:2], high.position[:2]) - low.kind.radius - high.kind.radius)
        return least


def above(x=0.0, z=0.8, **given):
    """A drone above a robot on wheels, and its bench."""
    bench = Bench((KHEPERA4, CRAZYFLIE), [(x, 0.0, 0.0), (x + 0.05, 0.0, z)], **given)
    return bench, bench.robots[1]


def test_drone_goes_aside_and_comes_down_there():
    bench, drone = above()
    ground = bench.robots[0]
    ground.ordered = True  # it stops at once
    bench.step()
    assert (ground.sinks_at, drone.landing.aside, drone.landing.place[2]) == (0.0, True, 0.8)
    assert drone.landing.robot_below() == "R0; it goes aside first"
    bench.until_down()
    assert 0.3 < drone.sinks_at < 2.0
    assert bench.gap() > NEAR
    assert hypot(*drone.position[:2]) < 0.4  # and not farther than it must


def test_without_a_robot_below_it_lands_at_once():
    beside = Bench((KHEPERA4, CRAZYFLIE), [(0.0, 0.0, 0.0), (0.3, 0.0, 0.8)])
    higher = Bench((CRAZYFLIE, CRAZYFLIE), [(0.0, 0.0, 1.2), (0.3, 0.0, 0.8)])
    for bench in (beside, higher, above(linked=False)[0]):
        drones = [robot for robot in bench.step().robots if robot.kind.flies]
        assert [(drone.landing.aside, drone.sinks_at) for drone in drones] == [(False, 0.0)] * len(drones)


EVENTS = {
    "blind": lambda bench, drone: setattr(bench, "lag", 1.0),
    "late": lambda bench, drone: setattr(drone.health, "missed_share", 1.0),
    "fallen": lambda bench, drone: setattr(drone, "lands", False),
    "landed otherwise": lambda bench, drone: setattr(drone.landing, "aside", False),
}


@for_each("event, given", [("blind", {}), ("late", {}), ("fallen", {}), (None, {"x": 3.05}), (None, {"z": 0.15})])
def test_drone_that_cannot_go_aside_lands_in_place(event, given):
    bench, drone = above(**given)
    if event:
        EVENTS[event](bench, drone)
    bench.step()
    assert (drone.landing.aside, drone.sinks_at) == (False, 0.0)


@pytest.mark.parametrize(("event", "sinks_at"), [("fallen", inf), ("landed otherwise", inf), ("blind", DT)])
def test_way_aside_ends(event, sinks_at):
    """A robot that only lost its pose sinks by itself; otherwise an order has reached the body."""
    bench, drone = above()
    assert bench.step().robots[1].landing.aside
    EVENTS[event](bench, drone)
    bench.step()
    assert (drone.landing.aside, drone.sinks_at) == (False, pytest.approx(sinks_at))


def test_search_for_a_place_ends():
    bench, drone = above()
    while bench.t < PATIENCE_S + 0.5:
        bench.robots[0].position = (*drone.position[:2], 0.0)  # the robot below goes along
        bench.step()
    assert drone.sinks_at == pytest.approx(PATIENCE_S, abs=2 * DT)
    grid = [(0.2 * column, 0.2 * row, 0.0) for column in range(-2, 3) for row in range(-2, 3)]  # no place is free
    full = Bench((KHEPERA4,) * len(grid) + (CRAZYFLIE,), [*grid, (0.0, 0.0, 0.8)], arena=(1.0, 1.0, 2.0))
    assert full.step().step().robots[-1].sinks_at <= DT


@pytest.mark.parametrize("lost", [False, True])
def test_lost_drone_above_may_have_come_down(lost):
    bench = Bench((CRAZYFLIE, CRAZYFLIE), [(0.0, 0.0, 1.5), (0.05, 0.0, 0.8)])
    higher, lower = bench.robots
    higher.lands = higher.ordered = False
    lower.neighbours.receive(0, higher.position, higher.velocity, 0.0, 0.0)
    if lost:
        bench.t, bench.silent = 1.0, True
        lower.neighbours.mark_lost(0, 0.5)
    bench.step()
    assert (lower.landing.aside, isfinite(lower.sinks_at)) == (lost, not lost)


@pytest.mark.parametrize("seed", mostly_slow(range(12), 4))
def test_landing_drones_touch_no_robot(seed):
    """All drones land at once over and beside robots on wheels; 12 x 10 scenes on 1.4 m x 1.4 m."""
    rng, made = random.Random(seed), 0
    while made < 10:
        heights = [rng.uniform(0.5, 1.2) if kind.flies else 0.0 for kind in SCENE]
        bench = Bench(SCENE, [(rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), z) for z in heights])
        if bench.gap() >= ROOM:
            made += 1
            bench.until_down()


@pytest.mark.parametrize("trigger", ["send-on-delta", "predictive"])
def test_drone_lands_beside_robot_that_died_moving(trigger):
    drone = RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=1.0)
    robots = {"F": drone, "K": RobotTable(kind="khepera4", start=[-0.4, 0.0])}
    leg = LegTable(at_s=0.0, robot="K", plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2})
    avoidance, sends = {"kind": "barrier", "hears": "all"}, {"kind": trigger, "threshold": 0.01}
    swarm = Swarm(small(robots, duration_s=60.0, trigger=sends, avoidance=avoidance, timeline=[leg])).running()
    while swarm.last("K", "truth")[0] < -0.02:
        swarm.step()
    place, robot = swarm.last("K", "truth")[:2], swarm.robot("F")
    swarm.groups.remove(swarm.where["K"][0])
    swarm.names = ("F",)
    robot.neighbours.mark_lost(0, swarm.t)
    swarm.run(3.0)
    robot.lifecycle.land("ordered to land")
    swarm.until(DONE)
    told = [each.text for each in robot.hazards.incidents if each.cause == Cause.BELOW]
    assert told[0] == "warn: a robot is below it: K; it goes aside first"
    assert dist(swarm.last("F", "truth")[:2], place) - CRAZYFLIE.radius - KHEPERA4.radius > NEAR


HOVER = 0.8
WALLS = [(kind, axis, side) for kind in KINDS for axis, side in ((0, 1.0), (1, -1.0))]
WALLS += [(kind, 2, 1.0) for kind in KINDS if KINDS[kind].flies]


@pytest.mark.parametrize(
    ("kind", "axis", "side", "latency_s"),
    mostly_slow([*((*wall, 0.0) for wall in WALLS), *((kind, 0, 1.0, 0.15) for kind in KINDS)], 3),
)
def test_no_robot_gets_beyond_a_wall(kind, axis, side, latency_s):
    """A guided robot 1 m before that wall, whose goal is 0.9 m beyond it."""
    start, goal, beyond = [0.1, 0.1, 0.0], [0.0, 0.0, HOVER], []
    start[axis] = side
    member = RobotTable(kind=kind, start=start[:2], hover=HOVER if KINDS[kind].flies else None)
    disturbance = {"all": Disturbance(latency_s=latency_s)}
    swarm = Swarm(small({"R": member}, architecture="centralised", disturbance=disturbance, duration_s=30.0))
    robot = swarm.robot("R")
    limits = robot.assignment.limits
    wall = (limits.high if side > 0.0 else limits.low)[axis]
    goal[axis] = wall + 0.9 * side
    for tick in range(round(9.0 / swarm.dt)):
        if tick % 10 == 0:
            robot.guidance.receive(tuple(goal), nan, swarm.t)
        swarm.step()
        robot.lifecycle.takeoff()
        if robot.lifecycle.start_at == inf:
            robot.start(swarm.t + 0.1)
        if swarm.phase("R") == RUNNING:
            beyond.append(side * (swarm.last("R", "truth")[axis] - wall) + (axis < 2) * KINDS[kind].radius)
    assert swarm.phase("R") == RUNNING, robot.lifecycle.reason
    assert -0.1 < max(beyond) < 0.001
