"""Robots whose ways cross at random, and an obstacle course: with the barrier none touches another, and all arrive.

Bodies are point masses: robots that touch go through each other, and the overlap of their cylinders can be measured.
"""

import itertools
import math

import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from agents.body.kinds import KINDS
from agents.decision.lifecycle import RUNNING
from experiments.definition.experiment import Arena, ChannelTable, LegTable, Rates, RobotTable, Start
from experiments.definition.plan import Plan
from experiments.virtual_time.simulation import simulate
from tests.experiments.traces import link_errors
from tests.runs import flown
from tests.small import changed, small
from twins import scene as outlines
from twins.arrays import norm

pytestmark = pytest.mark.slow

POTENTIAL = {"kind": "potential", "hears": "all"}
BARRIER = {"kind": "barrier", "hears": "all"}
PAIRS = tuple(itertools.combinations_with_replacement(("crazyflie", "tello", "khepera4", "turtlebot3"), 2))
CIRCLE = 0.8  # [m] robots begin about here and want to go to the other side
ARRIVED = 0.05  # [m] nearer than this to its goal at the end a robot has arrived
SPEED = {"twist": 0.2, "velocity": 0.4, "position": 0.4}  # [m/s] of the plans
PATIENCE = 3.0  # times the time that the way would take alone; avoiding each other takes up to 2.6 of them
ANGLES = (math.pi, 0.5 * math.pi)  # head-on, and across
WOBBLE = Disturbance(hover_jitter=Jitter(0.01))


def encounter(kinds, avoidance, *, between=math.pi, sensors=(), duration_s=None):
    """Robots that want to change sides of a circle, all at the same time.

    Args:
        between: Angle between the starts of one robot and the next [rad]; more than two are spread evenly.
        duration_s: Of the run [s]; `PATIENCE` times the slowest's way if left out.
    """
    low = [KINDS[kind].height for kind in kinds if not KINDS[kind].flies]
    height = 0.5 * min(low) if low else 0.5  # beside what drives [m]
    speeds = [SPEED[KINDS[kind].takes] for kind in kinds]
    robots, timeline = {}, []
    for number, kind in enumerate(kinds):
        angle = number * (between if len(kinds) == 2 else 2.0 * math.pi / len(kinds))
        x, y = CIRCLE * math.cos(angle), CIRCLE * math.sin(angle)
        name, hover = f"R{number}", height if KINDS[kind].flies else None
        robots[name] = RobotTable(kind=kind, start=[x, y, angle + math.pi], hover=hover, sensors=list(sensors))
        plan = {"kind": "waypoints", "points": [[-x, -y]], "speed": speeds[number]}
        timeline.append(LegTable(at_s=0.0, robot=name, plan=plan))
    return small(
        robots,
        duration_s=2.0 * CIRCLE / min(speeds) * PATIENCE if duration_s is None else duration_s,
        arena=Arena(size=(4.0, 4.0, 2.5)),
        rates=Rates(state_hz=100.0),
        timeline=timeline,
        trigger={"kind": "send-on-delta", "threshold": 0.01},
        disturbance={"all": Disturbance(position_sigma=0.0003), "crazyflie": WOBBLE, "tello": WOBBLE},
        avoidance=avoidance,
        start=Start(scatter=0.35, scatter_yaw=math.pi),
    )


def outcome(experiment, log):
    """Smallest gap between surfaces of robots beside each other [m], farthest from a goal [m], share of avoidance."""
    kinds = [KINDS[robot.kind] for robot in experiment.robots.values()]
    place = log.true_position[(log.phase == RUNNING).all(axis=1)]
    gap = np.inf
    for (i, first), (j, second) in itertools.combinations(enumerate(kinds), 2):
        apart = place[:, i] - place[:, j]
        over, up = norm(apart[:, :2]) - first.radius - second.radius, apart[:, 2]
        beside = (up < second.height) & (up > -first.height)
        gap = min(gap, over[beside].min(initial=np.inf))
    goals = {leg.robot: leg.plan["points"][-1] for leg in experiment.timeline}
    missed = norm(place[-1, :, :2] - np.array([goals[name] for name in log.names])).max()
    return gap, missed, log.avoided.max() / log.ticks


def meet(experiment, seeds):
    """Outcomes of encounters, one for each seed."""
    return [outcome(experiment, simulate(Plan(experiment), seed)) for seed in seeds]


def met(kinds, avoidance, each, **settings):
    """Outcomes of robots head-on and across, `each` of either."""
    head_on, across = (encounter(kinds, avoidance, between=angle, **settings) for angle in ANGLES)
    return meet(head_on, range(1, each + 1)) + meet(across, range(1, each + 1))


def assert_clear(found, least=0.0, arrived=1.0):
    gap, missed, avoided = np.array(found).T
    assert gap.min() > least
    assert (missed <= ARRIVED).mean() >= arrived
    return gap, avoided


def test_without_avoidance_robots_collide():
    gap, avoided = assert_clear(met(("turtlebot3", "turtlebot3"), None, 3, duration_s=12.0), -np.inf)
    assert (gap < 0.0).sum() >= 3
    assert gap.min() < -0.1
    assert not avoided.any()


def test_barrier_keeps_robots_apart_until_arrival():
    _, avoided = assert_clear(met(("khepera4", "tello"), BARRIER, 3, duration_s=20.0), 0.01)
    assert (avoided > 0.0).any()


@pytest.mark.timeout(600)
@pytest.mark.nightly
def test_thousand_random_encounters_without_collision():
    seeds = {math.pi: range(1, 51), 0.5 * math.pi: range(51, 101)}
    whole = []
    for kinds, angle in itertools.product(PAIRS, ANGLES):
        whole += meet(encounter(kinds, BARRIER, between=angle), seeds[angle])
    assert len(whole) == 1000
    assert_clear(whole, 0.02, arrived=0.995)  # arrival is not guaranteed


def test_wheels_pass_edge_of_the_potential():
    """A push that jumps to its full size at the edge stops these."""
    for angle, seed in zip(ANGLES, (7, 23), strict=True):
        assert_clear(meet(encounter(("turtlebot3", "turtlebot3"), POTENTIAL, between=angle), [seed]), 0.1)


@pytest.mark.parametrize("seeds", [3, pytest.param(20, marks=pytest.mark.nightly)])
def test_four_kinds_change_sides(seeds):
    kinds = ("khepera4", "turtlebot3", "crazyflie", "tello")
    assert_clear(meet(encounter(kinds, BARRIER), range(1, 1 + seeds)), arrived=0.95)


def test_robots_with_sensors_alone_keep_clear():
    sensors = ["infrared", "ultrasonic"]
    assert_clear(met(("khepera4", "khepera4"), {"kind": "barrier"}, 2, sensors=sensors))


@pytest.mark.nightly
@pytest.mark.parametrize("kinds", [("tello", "tello"), ("crazyflie", "turtlebot3")])
def test_bad_network_causes_no_collision(kinds):
    bad = ChannelTable(delay_s=0.02, jitter_s=0.02, loss=0.2)
    assert_clear(meet(changed(encounter(kinds, BARRIER), channel=bad), range(1, 21)))


@pytest.mark.parametrize("case", [pytest.param("periodic", marks=pytest.mark.nightly), "event"])
def test_it_passes_without_contact_and_recovers(case):
    flight = flown("obstacle-course", case)
    plan, log, scene, radius = flight.plan, flight.log, flight.plan.scene, KINDS["turtlebot3"].radius
    run = (log.time >= 0.0) & (log.time <= plan.experiment.duration_s)
    time, place = log.time[run], log.true_position[run]
    assert log.touches == ()
    for k in range(len(scene.names)):
        assert (outlines.distance(scene, k, scene.pose[k], place[..., :2]) > radius + 0.04).all()
    i, j = np.triu_indices(place.shape[1], 1)
    assert (norm(place[:, i, :2] - place[:, j, :2]) > 2.0 * radius + 0.04).all()
    assert (place[-1, :, 0] > 0.5).all()  # all are through
    error = link_errors(plan.links, place).max(axis=1)
    assert error.max() > 0.3  # it had to fold
    assert error[time > 75.0].max() < 0.025
