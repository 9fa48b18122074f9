"""How an experiment would go if nothing disturbed it: perfect communication, robots without inertia, an empty room.

The laws and plans are those of `agents.Agent`; this file only closes the loop, in a tenth of the time that a run in
virtual time takes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agents.agent import Agent
from agents.assignment import Assignment
from agents.body import BodyState, Disturbance
from agents.coordination import Law
from agents.graph import Links
from agents.kinds import Kind
from agents.prediction import HOLD, Predictor
from agents.rows import Array, Index, clamp, norm
from agents.speaking import Voice
from agents.triggers import Periodic, Trigger

FAR = 1e6  # [m] walls that nobody meets
DECISIONS = 6000  # as many are predicted: ten minutes at the usual rate
QUESTIONS = 6000  # as often the trigger is asked
PAIRS = 1_000_000  # distances that are held in memory at once


@dataclass(frozen=True)
class Prediction:
    """Where the robots are at each decision (T): `time` (T,) [s] after the common start, `position` (T, N, 3) [m]."""

    time: Array
    position: Array


def closed(kinds: Sequence[Kind], hz: float) -> Array:
    """h (N,): the share of a position error that each robot closes between two decisions."""
    return 1.0 - np.exp(-np.array([kind.response for kind in kinds]) / hz)


def predict(assignment: Assignment, start: Array, yaw: Array, leads: Index, hz: float) -> Prediction:
    """Positions from the common start to the end, or to the last decision that is predicted.

    Args:
        assignment: Of all robots.
        start: (N, 3) on the floor, or wherever they are at the common start [m].
        yaw: (N,) then [rad].
        leads: Rows that follow their plans exactly.
        hz: Decisions per second.
    """
    count = min(DECISIONS, max(1, round(assignment.duration * hz)))
    limits = replace(assignment.limits, low=np.full(3, -FAR), high=np.full(3, FAR), separation=None)
    agent = Agent(
        replace(
            assignment,
            body_hz=hz,
            decide_every=1,
            pose_every=4 * DECISIONS,
            trigger=Periodic(),
            predictor=HOLD,
            update=None,
            limits=limits,
            avoidance=None,  # it acts on what range sensors see, and here they see nothing
            duration=2.0 * assignment.duration + 1.0,  # it must not end before the last decision
        )
    )
    agent.find(np.arange(len(assignment.links)))
    share = closed(assignment.kinds, hz)[:, None]
    speed = np.minimum([kind.speed for kind in assignment.kinds], assignment.limits.speed)[:, None] / hz
    flies = np.array([kind.flies for kind in assignment.kinds])[:, None]
    position = start.copy()
    _made_ready(agent, position, yaw, hz)
    track = np.empty((count + 1, *start.shape))
    for tick in range(count):
        track[tick] = position
        _step(agent, tick / hz, position, yaw)
        step = share * (agent.goal - position)
        length = np.where(flies, np.abs(step), norm(step)[:, None])  # the limit of a flying robot holds for each axis
        position = position + step * np.minimum(1.0, speed / np.maximum(length, 1e-300))
        position[leads] = agent.goal[leads]
        position = np.nan_to_num(clamp(position, -FAR, FAR), nan=FAR)  # what overflowed is out of sight as well
    track[count] = position
    return Prediction(np.arange(count + 1) / hz, track)


def _made_ready(agent: Agent, position: Array, yaw: Array, hz: float) -> None:
    """Through the life of a robot to the common start at time 0."""
    rows = range(len(position))
    _step(agent, -4.0 / hz, position * [1.0, 1.0, 0.0], yaw)  # nobody takes off who does not stand on the floor
    for row in rows:
        agent.life.takeoff(row)
    _step(agent, -3.0 / hz, position, yaw)
    _step(agent, -2.0 / hz, position, yaw)
    for row in rows:
        agent.life.start(row, 0.0)


def _step(agent: Agent, t: float, position: Array, yaw: Array) -> None:
    """One decision of robots that stand in the air, or on the floor, and hear one another at once."""
    links, rows = agent.assignment.links, len(position)
    now, none = np.full(len(links), t), np.zeros((rows, 3))
    agent.hear(np.arange(len(links)), position[links.speaker], np.zeros((len(links), 3)), now, now)
    flying = np.array([kind.flies for kind in agent.assignment.kinds])
    agent.step(t, BodyState(np.full(rows, t), position, none, yaw, position, yaw, np.ones(rows), flying))


@dataclass(frozen=True)
class Approach:
    """The nearest that two robots come to each other: `distance` [m] in the plane, at `time` [s]."""

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
    predictor: Predictor,
    hz: float,
    rng: np.random.Generator,
) -> float:
    """Poses that all robots together would send in a second.

    Args:
        trigger: Asked along the predicted motion.
        law: For triggers that look at the formation error.
        links: Of the whole experiment.
        prediction: The motion.
        nature: Of each row; its hover jitter and its position noise count, because they make robots speak.
        predictor: Where neighbours believe each other to be.
        hz: How often the trigger is asked.
        rng: Of the jitter and the noise.
    """
    span = float(prediction.time[-1])
    count = max(1, min(QUESTIONS, round(span * hz)))
    time = np.arange(count) / hz
    position = _between(prediction, time)
    rows = position.shape[1]
    velocity = np.gradient(position, time, axis=0) if count > 1 else np.zeros_like(position)  # as robots know theirs
    position[..., :2] += _wobble(nature, (count, rows, 2), 1.0 / hz, rng)
    voice, still = Voice(trigger, rows, predictor), np.zeros((rows, 3))
    heard = position[:, links.speaker]
    spoken = 0
    for tick in range(count):
        link_error = law.error(position[tick], heard[tick], links)
        error, energy = links.onto_listeners(np.stack([link_error, 0.5 * link_error**2], axis=1), rows).T
        t = float(time[tick])
        said = voice.speak(
            t, position[tick], velocity[tick], error=error, energy=energy, start=np.zeros(rows), offset=still
        )
        spoken += len(said.rows)
    return spoken * hz / count


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
