"""Ideal run: one flight on the virtual clock, without noise, in an empty, endless room.

Everything else is that of a run: bodies with their limits and their inertia, triggers, updates, the modelled network,
the plans, and the 5 mm at which robots on wheels stop. Walls, obstacles and avoidance are left out, because what is
looked for is who would meet them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array, norm
from agents.body.external_pose import velocity_after
from agents.body.interface import Disturbance
from agents.body.kinds import Kind
from agents.decision.transmission import Transmitter
from agents.formation.graph import Links
from agents.plugins.laws import Law
from agents.plugins.predictors import Predictor
from agents.plugins.triggers import Trigger
from agents.safety.hazards import Incident, Outcome
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, World
from experiments.recording.trace import ROUNDING_S
from experiments.virtual_time import conductor, simulation

FAR: Final = 1e6  # [m] walls that nobody meets
TICK_COST: Final = 200.0  # robots whose arithmetic takes as long as what a tick costs in any case
WORK: Final = 6e6  # robot ticks, with that added, that are flown: 290 s of seven robots, 50 s of a thousand
REPETITIONS: Final = 5  # flights with noise, each with another seed
QUESTIONS: Final = 6000  # as often the trigger is asked
PAIRS: Final = 1_000_000  # distances that are held in memory at once


@dataclass(frozen=True)
class Prediction:
    """Predicted motion: positions at each decision."""

    time: Array  # (T,) [s] after the common start
    position: Array  # (T, N, 3) [m]
    incidents: tuple[Incident, ...] = ()  # what is wrong with robots on the way
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
        flights.append(Prediction(log.time[run], log.true_position[run, first:end], mine))
    return flights


@dataclass(frozen=True)
class Approach:
    """Closest approach of two robots: `distance` [m] in the plane, at `time` [s]."""

    first: int
    second: int
    distance: float
    time: float


def approaches(prediction: Prediction, kinds: Sequence[Kind], clearance: float) -> list[Approach]:
    """Pairs that come nearer than the sum of their radii while one is not above the other.

    Args:
        prediction: The motion.
        kinds: Of the rows.
        clearance: Free height from which on two robots pass above each other [m].
    """
    i, j = np.triu_indices(len(kinds), 1)
    radius, height = np.array([kind.radius for kind in kinds]), np.array([kind.height for kind in kinds])
    low, high = prediction.position[..., :2].min(axis=0), prediction.position[..., :2].max(axis=0)
    gap = np.maximum(low[i] - high[j], low[j] - high[i]).max(axis=1)
    meet = gap < radius[i] + radius[j]  # the areas in which they move: of many robots most never come near each other
    i, j = i[meet], j[meet]
    apart, layer = radius[i] + radius[j], (height[i] + height[j]) / 2.0 + clearance
    nearest, when = np.full(len(i), np.inf), np.zeros(len(i))
    block = max(1, PAIRS // max(1, len(i)))
    for begin in range(0, len(prediction.time), block):
        position = prediction.position[begin : begin + block]
        offset = position[:, i] - position[:, j]
        planar = np.where(np.abs(offset[..., 2]) < layer, norm(offset[..., :2]), np.inf)
        at = planar.argmin(axis=0)
        least = planar[at, np.arange(len(i))]
        nearer = least < nearest
        nearest[nearer], when[nearer] = least[nearer], prediction.time[begin + at[nearer]]
    return [Approach(int(i[k]), int(j[k]), float(nearest[k]), float(when[k])) for k in np.flatnonzero(nearest < apart)]


def message_rate(
    trigger: Trigger,
    law: Law,
    links: Links,
    prediction: Prediction,
    nature: Sequence[Disturbance],
    *,
    kinds: Sequence[Kind],
    predictor: Predictor,
    hz: float,
    rng: np.random.Generator,
) -> float:
    """Estimated rate of transmissions of all robots together [1/s].

    Args:
        trigger: Asked along the predicted motion.
        law: For triggers that look at the formation error.
        links: Of the whole experiment.
        prediction: The motion.
        nature: Of each row; its hover jitter and its position noise count, because they make robots speak.
        kinds: Of each row.
        predictor: Where neighbours believe each other to be.
        hz: How often the trigger is asked.
        rng: Of the jitter and the noise.
    """
    span = float(prediction.time[-1])
    count = max(1, min(QUESTIONS, round(span * hz)))
    time = np.arange(count) / hz
    position = _between(prediction, time)
    rows = position.shape[1]
    setpoint = np.zeros((count, rows, 4))
    setpoint[..., :3] = _asked(position, time, kinds)
    position[..., :2] += _wobble(nature, (count, rows, 2), 1.0 / hz, rng)
    velocity, still = np.zeros((rows, 3)), np.zeros((rows, 3))
    voice = Transmitter(trigger, rows, predictor, kinds=kinds)
    heard = position[:, links.sender]
    spoken = 0
    for tick in range(count):
        link_error = law.error(position[tick], heard[tick], links)
        error, energy = links.sum_by_receiver(np.stack([link_error, 0.5 * link_error**2], axis=1), rows).T
        t = float(time[tick])
        if tick:
            velocity = velocity_after(velocity, position[tick] - position[tick - 1], 1.0 / hz)
        said = voice.transmit(
            t, position[tick], velocity,
            error=error, energy=energy, start=np.zeros(rows), offset=still, setpoint=setpoint[tick],
        )  # fmt: skip
        spoken += len(said.rows)
    return spoken * hz / count


def _asked(position: Array, time: Array, kinds: Sequence[Kind]) -> Array:
    """Setpoints (K, N, 3) under which robots would move like this (K, N, 3) [m]: places ahead, or velocities."""
    velocity = np.gradient(position, time, axis=0) if len(time) > 1 else np.zeros_like(position)
    response = np.array([kind.response for kind in kinds])[:, None]
    by_place = np.array([kind.takes == "position" for kind in kinds])[:, None]
    return np.where(by_place, position + velocity / response, velocity)


def _between(prediction: Prediction, time: Array) -> Array:
    """Positions (K, N, 3) at other times (K,), on straight lines between the decisions."""
    last = len(prediction.time) - 1
    at = np.minimum(time * last / max(float(prediction.time[-1]), 1e-12), last)
    before = np.minimum(at.astype(np.intp), max(last - 1, 0))
    share = (at - before)[:, None, None]
    after = np.minimum(before + 1, last)
    return np.asarray(prediction.position[before] * (1.0 - share) + prediction.position[after] * share)


def _wobble(nature: Sequence[Disturbance], shape: tuple[int, int, int], dt: float, rng: np.random.Generator) -> Array:
    """Hover jitter and measurement noise of x and y (K, N, 2) [m]."""
    jitter = [each.hover_jitter for each in nature]
    sigma = np.array([0.0 if each is None else each.sigma for each in jitter])[:, None]
    keep = np.array([0.0 if each is None else math.exp(-dt / each.correlation_s) for each in jitter])[:, None]
    white = np.array([each.position_sigma or 0.0 for each in nature])[:, None]
    wobble = rng.normal(size=shape) * sigma
    for k in range(1, len(wobble)):
        wobble[k] = keep * wobble[k - 1] + np.sqrt(1.0 - keep**2) * wobble[k]
    return np.asarray(wobble + white * rng.normal(size=shape))
