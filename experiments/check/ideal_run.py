"""Ideal run: one flight on the virtual clock, without noise, in an empty, endless room; beside it one with noise.

Everything else is that of a run: bodies with their limits and their inertia, triggers, updates, the modelled network,
the plans, and the 5 mm at which robots on wheels stop. Walls, obstacles and avoidance are left out: robots that would
meet them are sought.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import msgspec
import numpy as np

from agents.body.kinds import Kind
from agents.safety.hazards import HazardChange, Outcome
from agents.ticks import ROUNDING_S
from experiments.definition.experiment import WorldTable
from experiments.definition.plan import Plan
from experiments.recording.trace import poses_in_run
from experiments.virtual_time import conductor, simulation, stretch
from twins.arrays import Array, norm

ENDLESS_M: Final = 1e6  # [m] walls that no robot meets
WORK: Final = 2.2e5  # robot ticks that are flown, of 10 to 20 µs each: 310 s of seven robots, 2 s of a thousand
SPEED_UP: Final = 15.0  # factor of the work that compiled functions fly: 33 s of a thousand
STEPS_UP: Final = 3.0  # likewise, for laws with steps in Python
REPETITIONS: Final = 5  # flights with noise, each with another seed


@dataclass(frozen=True)
class Prediction:
    """Predicted motion: positions at each decision."""

    bare: Plan  # flown experiment, see `isolated`
    time: Array  # (T,) [s] after the common start
    position: Array  # (T, N, 3) [m]
    transmissions: int  # number of all robots in the run
    messages_hz: float  # rate of all robots, with the noise of the experiment, which makes robots transmit
    incidents: tuple[tuple[int, HazardChange], ...] = ()  # hazards on the way, each with the row of its robot
    velocities: tuple[bool, ...] = ()  # (N) robots with a velocity from the last step of their law; empty if stuck
    stuck: str = ""  # reason why the run does not begin; the robots stay at their starts then
    noisy: Prediction | None = None  # the flight beside it with the noise of the experiment and its seed, if there was

    @property
    def end_s(self) -> float:
        """Time of the last position [s]."""
        return float(self.time[-1])


def has_noise(plan: Plan) -> bool:
    """Whether a robot is disturbed by noise."""
    own = [plan.disturbance(name) for name in plan.names]
    return any(each != each.without_noise() for each in own)


def isolated(plan: Plan) -> Plan:
    """The same without walls, obstacles, avoidance and shadows, as far as it is flown for `check`."""
    experiment = plan.experiment
    robots = {
        name: msgspec.structs.replace(robot, shadow=None, sensors=None, lands_at_s=None)
        for name, robot in experiment.robots.items()
    }
    bare = plan.changed(
        title="",
        source="",
        cases={},
        robots=robots,
        arena=msgspec.structs.replace(
            experiment.arena, size=(ENDLESS_M, ENDLESS_M, ENDLESS_M), walls=False, obstacles={}, starts={}
        ),
        world=WorldTable(),
        avoidance=None,
        safety=msgspec.structs.replace(experiment.safety, separation=None),
        rates=msgspec.structs.replace(experiment.rates, state_hz=experiment.rates.coordination_hz),
    )
    rate = experiment.rates.body_hz * len(robots)
    seconds = max(1.0, math.floor(flown_ticks(bare, experiment.duration_s * rate) / rate))
    return bare.changed(duration_s=min(experiment.duration_s, seconds))


def flown_ticks(bare: Plan, ticks: float) -> float:
    """Robot ticks that are flown, of `ticks`."""
    return WORK if ticks <= WORK else uncompiled(bare)[1] * WORK


def uncompiled(bare: Plan) -> tuple[str, float]:
    """Reason why ticks of a plan, or steps of its law, are not compiled, and its speed-up, as a second of it shows."""
    stretch.WORK[0] += stretch.PAYS_S
    flight = simulation.VirtualRun(bare.changed(duration_s=1.0), bare.experiment.seed, quiet=True, lean=True)
    with suppress(conductor.Stuck):
        flight.fly(landing=False)
    if flight.stretches is None or flight.stretches.refusal:
        return "it is not possible" if flight.stretches is None else flight.stretches.refusal, 1.0
    steps = flight.stretches.called_back
    return steps, STEPS_UP if steps else SPEED_UP


def ticking_plugins(plan: Plan) -> list[type]:
    """Classes of the plug-ins that a tick calls."""
    return [type(each) for each in (plan.law, plan.trigger, plan.update, plan.predictor, plan.avoidance)]


def predict(plan: Plan) -> Prediction:
    """Flight without noise from the common start to the end; a flight with noise at its side counts the messages."""
    bare = isolated(plan)
    ideal = fly(bare, bare.experiment.seed, quiet=True)
    if not has_noise(bare) or bare.trigger.TIMED:
        return ideal
    noisy = fly(bare, bare.experiment.seed)
    if noisy.stuck and not ideal.stuck:  # only the noise holds the robots back
        return ideal
    return replace(ideal, messages_hz=noisy.messages_hz, noisy=noisy)


def repetitions(bare: Plan) -> int:
    """Number of flights with different seeds: as many as take twice `WORK`, at most `REPETITIONS`."""
    ticks = bare.experiment.duration_s * bare.experiment.rates.body_hz * len(bare.names)
    return max(1, min(REPETITIONS, int(2.0 * WORK / ticks)))


def fly(bare: Plan, seed: int, *, quiet: bool = False) -> Prediction:
    """Flight of what `isolated` made with a seed, `quiet`: without noise."""
    try:
        log = simulation.simulate(bare, seed, quiet=quiet, lean=True, landing=False)
    except conductor.Stuck as stuck:
        position = np.array(bare.start_poses()[0])
        position[:, 2] = [robot.hover or 0.0 for robot in bare.experiment.robots.values()]
        return Prediction(bare, np.zeros(1), position[None], transmissions=0, messages_hz=0.0, stuck=str(stuck))
    run, duration_s = log.time >= -ROUNDING_S, bare.experiment.duration_s
    begun = tuple(each for each in log.incidents if each[1].outcome > Outcome.NONE and 0.0 <= each[1].time < duration_s)
    sent = len(poses_in_run(log.sent, duration_s, "stamp"))
    return Prediction(bare, log.time[run], log.true_position[run], sent, sent / duration_s, begun, log.velocities)


PASSES_ABOVE: Final = 1e3  # [m] more than the sum of two radii


class PairApproach(NamedTuple):
    """Closest approach of two robots."""

    first: int
    second: int
    touch: float  # sum of their radii [m]
    distance: float  # distance in the plane [m]
    gap: float  # free height between them then, negative where none is above the other [m]
    time: float  # [s]


def approaches(prediction: Prediction, kinds: Sequence[Kind], clearance: float) -> list[PairApproach]:
    """Pairs that come nearer than the sum of their radii while neither is above the other by the clearance.

    Args:
        clearance: Free height from which on two robots pass above each other undisturbed [m].
    """
    radius, height = np.array([kind.radius for kind in kinds]), np.array([kind.height for kind in kinds])
    low, high = prediction.position[..., :2].min(axis=0), prediction.position[..., :2].max(axis=0)
    found: list[PairApproach] = []
    for i in range(len(kinds) - 1):
        # the areas in which they move: of many robots most never come near each other
        apart = np.maximum(low[i] - high[i + 1 :], low[i + 1 :] - high[i]).max(axis=1)
        j = i + 1 + np.flatnonzero(apart < radius[i] + radius[i + 1 :])
        offset = prediction.position[:, j] - prediction.position[:, i, None]
        between = np.maximum(offset[..., 2] - height[i], -offset[..., 2] - height[j])
        far = norm(offset[..., :2])
        # where bodies pass through each other comes before where one is above the other
        touch = radius[i] + radius[j]
        where = [far >= touch, between < 0.0, between < clearance]
        rank = np.select(where, [np.inf, far, far + PASSES_ABOVE], np.inf)
        at = rank.argmin(axis=0)
        for k in np.flatnonzero(np.isfinite(rank.min(axis=0))):
            when = at[k]
            nearest = float(far[when, k]), float(between[when, k]), float(prediction.time[when])
            found.append(PairApproach(i, int(j[k]), float(touch[k]), *nearest))
    return found
