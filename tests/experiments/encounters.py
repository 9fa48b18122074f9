"""Random encounters of robots whose ways cross: whether an avoidance keeps them from touching, and lets them pass.

Everything happens in virtual time with point masses, so that two robots that touch go through each other and the
overlap of their true cylinders can be measured.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from agents.body.interface import Disturbance, Jitter
from agents.body.kinds import KINDS
from agents.decision.lifecycle import RUNNING
from experiments.definition.experiment import Arena, Experiment, LegTable, Rates, RobotTable, Start
from experiments.definition.plan import Plan
from experiments.virtual_time.simulation import VirtualRunLog, simulate
from twins.arrays import Array, Mask, norm

CIRCLE: Final = 0.8  # [m] robots begin about here and want to go to the other side
SCATTER: Final = 0.35  # [m] on each axis
ARRIVED: Final = 0.05  # [m] nearer than this to its goal at the end a robot has arrived
SPEED: Final = {"twist": 0.2, "velocity": 0.4, "position": 0.4}  # [m/s] of the plans
PATIENCE: Final = 3.0  # times the time that the way would take alone; avoiding each other takes up to 2.6 of them
IN_THE_AIR: Final = 0.5  # [m] height of drones among themselves
ANGLES: Final = (math.pi, 0.5 * math.pi)  # head-on, and across
PAIRS: Final = tuple(itertools.combinations_with_replacement(("crazyflie", "tello", "khepera4", "turtlebot3"), 2))


@dataclass(frozen=True)
class Outcome:
    """Results of encounters (M)."""

    # (M,) smallest distance between the surfaces of two robots beside each other [m]; negative: they overlapped
    gap: Array
    missed: Array  # (M,) how far from its goal the farthest robot was at the end [m]
    avoided: Array  # (M,) share of the ticks on which avoidance changed what some robot did

    @property
    def collided(self) -> Mask:
        """(M,) encounters in which two robots overlapped."""
        return self.gap < 0.0

    @property
    def arrived(self) -> Mask:
        """(M,) encounters after which every robot was at its goal."""
        return self.missed <= ARRIVED

    @classmethod
    def joined(cls, parts: Iterable[Outcome]) -> Outcome:
        """Those of several runs."""
        columns = zip(*((part.gap, part.missed, part.avoided) for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def __str__(self) -> str:
        many = len(self.gap)
        return (
            f"{int(self.collided.sum())} collisions in {many} encounters, closest {self.gap.min():+.3f} m; "
            f"{int(self.arrived.sum())} arrived; avoidance acted on {self.avoided.mean():.0%} of the ticks"
        )


def encounter(
    kinds: Sequence[str],
    avoidance: str | dict[str, Any] | None,
    *,
    between: float = math.pi,
    stubborn: int = 0,
    sensors: Sequence[str] = (),
    duration_s: float | None = None,
) -> Experiment:
    """Robots that want to change sides of a circle, all at the same time.

    Args:
        kinds: Of the robots.
        avoidance: As in an experiment file.
        between: Angle between the places where one robot and the next begin [rad]; more than two are spread evenly.
        stubborn: So many of them, from the last, avoid no robot.
        sensors: Range sensors of all of them; none: they only hear each other.
        duration_s: How long they have for it [s]; `PATIENCE` times the slowest's way if left out.
    """
    low = [KINDS[kind].height for kind in kinds if not KINDS[kind].flies]
    height = 0.5 * min(low) if low else IN_THE_AIR  # beside what drives
    speeds = [SPEED[KINDS[kind].takes] for kind in kinds]
    robots, timeline = {}, []
    for number, kind in enumerate(kinds):
        angle = number * (between if len(kinds) == 2 else 2.0 * math.pi / len(kinds))
        x, y = CIRCLE * math.cos(angle), CIRCLE * math.sin(angle)
        name = f"R{number}"
        robots[name] = RobotTable(
            kind=kind,
            start=[x, y, angle + math.pi],
            hover=height if KINDS[kind].flies else None,
            sensors=list(sensors),
            avoids=number < len(kinds) - stubborn,
        )
        plan = {"kind": "waypoints", "points": [[-x, -y]], "speed": speeds[number]}
        timeline.append(LegTable(at_s=0.0, robot=name, plan=plan))
    wobble = Disturbance(hover_jitter=Jitter(0.01))
    return Experiment(
        title="Robots that change sides",
        robots=robots,
        duration_s=2.0 * CIRCLE / min(speeds) * PATIENCE if duration_s is None else duration_s,
        arena=Arena(size=(4.0, 4.0, 2.5)),
        rates=Rates(state_hz=100.0),
        timeline=timeline,
        trigger={"kind": "send-on-delta", "threshold": 0.01},
        disturbance={"all": Disturbance(position_sigma=0.0003), "crazyflie": wobble, "tello": wobble},
        avoidance=avoidance,
        start=Start(scatter=SCATTER, scatter_yaw=math.pi),
    )


def meet(experiment: Experiment, seeds: Sequence[int]) -> Outcome:
    """Encounters, one for each seed.

    Raises:
        experiments.virtual_time.conductor.Stuck: If robots do not take off or land.
    """
    return Outcome.joined(_outcome(experiment, simulate(Plan(experiment), seed)) for seed in seeds)


def random_pairs(avoidance: str | dict[str, Any] | None, each: int, **settings: Any) -> dict[str, Outcome]:
    """Encounters of all pairs of kinds, head-on and across: `each` of either; further settings as of `encounter`.

    With 50 of each it is a thousand: 10 pairs, 2 directions.
    """
    outcomes = {}
    for first, second in PAIRS:
        parts = []
        for number, between in enumerate(ANGLES):
            seeds = range(1 + number * each, 1 + (number + 1) * each)
            parts.append(meet(encounter((first, second), avoidance, between=between, **settings), seeds))
        outcomes[f"{first} and {second}"] = Outcome.joined(parts)
    return outcomes


def _outcome(experiment: Experiment, log: VirtualRunLog) -> Outcome:
    kinds = [KINDS[robot.kind] for robot in experiment.robots.values()]
    place = log.true_position[(log.phase == RUNNING).all(axis=1)]
    gap = np.inf
    for (i, first), (j, second) in itertools.combinations(enumerate(kinds), 2):
        apart = place[:, i] - place[:, j]
        over, up = norm(apart[:, :2]) - first.radius - second.radius, apart[:, 2]
        beside = (up < second.height) & (up > -first.height)
        gap = min(gap, over[beside].min(initial=np.inf))
    goals = {leg.robot: leg.plan["points"][-1] for leg in experiment.timeline if isinstance(leg.plan, dict)}
    missed = norm(place[-1, :, :2] - np.array([goals[name] for name in log.names])).max()
    return Outcome(*(np.array([each]) for each in (gap, missed, log.avoided.max() / log.ticks)))
