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
from experiments.metrics.clearance import Clearance
from experiments.virtual_time.simulation import simulate
from tests.experiments.traces import link_errors
from tests.runs import flown
from tests.small import changed, small
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
    """Robots that change sides of a circle at once, two of them `between` apart [rad]; the slowest needs patience."""
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


def head_on_and_across(kinds, avoidance, **settings):
    return [encounter(kinds, avoidance, between=angle, **settings) for angle in ANGLES]


def meet(experiments, seeds):
    """Gaps, and shares of avoidance, of encounters: of each experiment with each seed; and who arrived."""
    found = [outcome(each, simulate(Plan(each), seed)) for each in experiments for seed in seeds]
    gap, missed, avoided = np.array(found).T
    return gap, avoided, (missed <= ARRIVED).mean()


def test_without_avoidance_robots_collide():
    gap, avoided, _ = meet(head_on_and_across(("turtlebot3", "turtlebot3"), None, duration_s=12.0), (1, 2, 3))
    assert ((gap < 0.0).sum() >= 3, gap.min() < -0.1, avoided.any()) == (True, True, False)


WHEELS = head_on_and_across(("turtlebot3", "turtlebot3"), POTENTIAL)  # a push that jumps to its full size stops these
SENSING = head_on_and_across(("khepera4", "khepera4"), {"kind": "barrier"}, sensors=["infrared", "ultrasonic"])
FOUR = [encounter(("khepera4", "turtlebot3", "crazyflie", "tello"), BARRIER)]
BAD = ChannelTable(delay_s=0.02, jitter_s=0.02, loss=0.2)


@pytest.mark.parametrize(
    ("experiments", "seeds", "least", "arrived"),
    [
        pytest.param(head_on_and_across(("khepera4", "tello"), BARRIER, duration_s=20.0), 3, 0.01, 1.0, id="barrier"),
        pytest.param(WHEELS[:1], [7], 0.1, 1.0, id="edge of the potential, head-on"),
        pytest.param(WHEELS[1:], [23], 0.1, 1.0, id="edge of the potential, across"),
        pytest.param(FOUR, 3, 0.0, 0.95, id="four kinds"),
        pytest.param(FOUR, 20, 0.0, 0.95, id="four kinds, often", marks=pytest.mark.nightly),
        pytest.param(SENSING, 2, 0.0, 1.0, id="sensors alone"),
        *[
            pytest.param([changed(encounter(kinds, BARRIER), channel=BAD)], 20, 0.0, 1.0, marks=pytest.mark.nightly)
            for kinds in (("tello", "tello"), ("crazyflie", "turtlebot3"))
        ],
    ],
)
def test_robots_keep_apart_until_they_arrive(experiments, seeds, least, arrived):
    gap, avoided, share = meet(experiments, range(1, 1 + seeds) if isinstance(seeds, int) else seeds)
    assert gap.min() > least
    assert share >= arrived
    assert avoided.any()


@pytest.mark.nightly
def test_thousand_random_encounters_without_collision():
    found = [
        meet([encounter(kinds, BARRIER, between=angle)], range(first, first + 50))
        for kinds, (angle, first) in itertools.product(PAIRS, zip(ANGLES, (1, 51), strict=True))
    ]
    gaps = np.concatenate([gap for gap, *_ in found])
    assert (len(gaps), gaps.min() > 0.02) == (1000, True)
    assert np.mean([share for *_, share in found]) >= 0.995  # arrival is not guaranteed


@pytest.mark.nightly
@pytest.mark.parametrize("case", ["periodic", "event"])
def test_it_passes_without_contact_and_recovers(case):
    flight = flown("obstacle-course", case)
    clearance = Clearance.of_trace(flight.trace)
    assert (clearance.overlaps, flight.log.touches) == ((), ())
    assert min(approach.gap for approach in (*clearance.robots, *clearance.arena)) > 0.04
    time, place = flight.trace.time, flight.trace.true_position
    assert (place[-1, :, 0] > 0.5).all()  # all are through
    error = link_errors(flight.plan.links, place).max(axis=1)
    assert error.max() > 0.3  # it had to fold
    assert error[time > 75.0].max() < 0.025
