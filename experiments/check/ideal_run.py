"""Ideal run: one flight on the virtual clock, without noise, in an empty, endless room.

Everything else is that of a run: bodies with their limits and their inertia, triggers, updates, the modelled network,
the plans, and the 5 mm at which robots on wheels stop. Walls, obstacles and avoidance are left out: robots that would
meet them are sought.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import msgspec
import numpy as np

from agents.arrays import Array, norm
from agents.body.kinds import Kind
from agents.safety.hazards import Incident, Outcome
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, World
from experiments.recording.trace import ROUNDING_S, sent_in_run
from experiments.virtual_time import conductor, simulation

FAR: Final = 1e6  # [m] walls that no robot meets
TICK_COST: Final = 200.0  # robots whose arithmetic takes as long as what a tick costs in any case
WORK: Final = 6e6  # robot ticks, with that added, that are flown: 290 s of seven robots, 50 s of a thousand
REPETITIONS: Final = 5  # flights with noise, each with another seed
QUESTIONS: Final = 6000  # to the trigger, from which the rate of transmissions is estimated


@dataclass(frozen=True)
class Prediction:
    """Predicted motion: positions at each decision."""

    time: Array  # (T,) [s] after the common start
    position: Array  # (T, N, 3) [m]
    incidents: tuple[Incident, ...] = ()  # hazards of robots on the way
    transmissions: int = 1  # of all robots in the run
    stuck: str = ""  # reason why the run does not begin; the robots stay at their starts then


def closed_shares(kinds: Sequence[Kind], hz: float) -> Array:
    """h (N,): the share of a position error that each robot closes between two decisions."""
    return 1.0 - np.exp(-np.array([kind.response for kind in kinds]) / hz)


def undisturbed(experiment: Experiment) -> Experiment:
    """The same as `isolated`, without noise."""
    quiet = {
        name: msgspec.structs.replace(each, hover_jitter=None, position_sigma=None, yaw_sigma=None, odometry_drift=None)
        for name, each in experiment.disturbance.items()
    }
    return msgspec.structs.replace(isolated(experiment), disturbance=quiet)


def isolated(experiment: Experiment) -> Experiment:
    """The same without scatter, walls, obstacles, avoidance and shadows, as far as it is flown for `check`."""
    robots = {
        name: msgspec.structs.replace(robot, shadow=None, sensors=None) for name, robot in experiment.robots.items()
    }
    ticks = WORK / (len(robots) + TICK_COST)
    return msgspec.structs.replace(
        experiment,
        title="",
        source="",
        cases={},
        duration_s=min(experiment.duration_s, max(1.0, math.floor(ticks / experiment.rates.body_hz))),
        robots=robots,
        arena=msgspec.structs.replace(experiment.arena, size=(FAR, FAR, FAR), walls=False, obstacles={}, starts={}),
        world=World(),
        avoidance=None,
        start=msgspec.structs.replace(experiment.start, scatter=0.0, scatter_yaw=0.0),
        safety=msgspec.structs.replace(experiment.safety, separation=None),
        rates=msgspec.structs.replace(experiment.rates, state_hz=experiment.rates.coordination_hz),
    )


def predict(bare: Experiment) -> Prediction:
    """Flight of what `undisturbed` or `isolated` made of an experiment, from the common start to the end."""
    return fly_repeatedly(bare, 1)[0]


def repetitions(bare: Experiment) -> int:
    """Number of flights with different seeds, side by side, that take twice as long as one flight at most."""
    return max(1, min(REPETITIONS, int(TICK_COST) // len(bare.robots)))


def fly_repeatedly(bare: Experiment, count: int) -> list[Prediction]:
    """`count` flights, the first with the seed of the experiment, each other one with the next seed; see `predict`."""
    names = tuple(bare.robots)
    try:
        log = simulation.simulate(bare, [bare.seed + k for k in range(count)], lean=True, landing=False)
    except conductor.Stuck as stuck:
        position, _ = bodies.start_poses(bare, names)
        position[:, 2] = np.nan_to_num(bodies.hover_heights(bare, names))
        return [Prediction(np.zeros(1), position[None], stuck=str(stuck))] * count
    run = log.time >= -ROUNDING_S
    begun = [each for each in log.incidents if each.outcome > Outcome.NONE and 0.0 <= each.time < bare.duration_s]
    flights = []
    for k in range(count):
        first, end = k * len(names), (k + 1) * len(names)
        mine = tuple(each._replace(row=each.row - first) for each in begun if first <= each.row < end)
        sent = len(sent_in_run(log.sent, bare.duration_s))  # of all flights: none is none in each
        flights.append(Prediction(log.time[run], log.true_position[run, first:end], mine, sent))
    return flights


class Approach(NamedTuple):
    """Closest approach of two robots: `distance` [m] in the plane, at `time` [s]."""

    first: int
    second: int
    distance: float
    time: float


def approaches(prediction: Prediction, kinds: Sequence[Kind], clearance: float) -> list[Approach]:
    """Pairs that come nearer than the sum of their radii while one is not above the other.

    Args:
        clearance: Free height from which on two robots pass above each other [m].
    """
    radius, height = np.array([kind.radius for kind in kinds]), np.array([kind.height for kind in kinds])
    low, high = prediction.position[..., :2].min(axis=0), prediction.position[..., :2].max(axis=0)
    found: list[Approach] = []
    for i in range(len(kinds) - 1):
        # the areas in which they move: of many robots most never come near each other
        apart = np.maximum(low[i] - high[i + 1 :], low[i + 1 :] - high[i]).max(axis=1)
        j = i + 1 + np.flatnonzero(apart < radius[i] + radius[i + 1 :])
        offset = prediction.position[:, i, None] - prediction.position[:, j]
        level = np.abs(offset[..., 2]) < (height[i] + height[j]) / 2.0 + clearance
        gap = np.where(level, norm(offset[..., :2]), np.inf)
        at = gap.argmin(axis=0)
        near = np.flatnonzero(gap.min(axis=0) < radius[i] + radius[j])
        found += [Approach(i, int(j[k]), float(gap[at[k], k]), float(prediction.time[at[k]])) for k in near]
    return found


def message_rate(experiment: Experiment) -> float:
    """Transmissions of all robots together in a flight with the noise of the experiment [1/s].

    Noise makes robots transmit; the flight takes `QUESTIONS` questions to the trigger at most.
    """
    duration = min(experiment.duration_s, QUESTIONS / experiment.rates.pose_hz)
    bare = isolated(msgspec.structs.replace(experiment, duration_s=duration))
    flight = predict(bare)
    return 0.0 if flight.stuck else flight.transmissions / bare.duration_s
