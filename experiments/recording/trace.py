"""What happened in one case of a run, as arrays; made by the virtual clock, or read back from a recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, TypeVar

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask
from agents.network import messages
from agents.network.messages import Contact, Event, WorldState
from agents.plugins import registry
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.recording.clocks import ClockOffset

EPOCH: Final = 1_700_000_000.0  # UTC [s] of the common start in virtual time: any, but the same in every run


ROUNDING_S: Final = 1e-6  # UTC seconds in a float are exact to a quarter of a microsecond
WALL: Final = "wall"  # of the arena, in contacts

M = TypeVar("M", Contact, WorldState)


def finds_contacts(engine: str | Mapping[str, object]) -> bool:
    """Whether an engine says of itself that it finds contacts, see `twins.engines.engine.EngineFactory`."""
    try:
        factory = registry.struct(registry.ENGINES, registry.split(engine)[0])
    except (registry.PluginError, msgspec.ValidationError):  # a recording is read where that engine is not installed
        return False
    return bool(getattr(factory, "contacts", False))


def within(said: Iterable[M], start: float, duration: float) -> tuple[M, ...]:
    """What was said in a run that began at `start` [s], in order of time, which then counts from there."""
    kept = [
        msgspec.structs.replace(each, stamp=max(each.stamp - start, 0.0))
        for each in said
        if -ROUNDING_S <= each.stamp - start <= duration + ROUNDING_S
    ]
    return tuple(sorted(kept, key=lambda each: each.stamp))


def looked_for(contacts: Sequence[Contact], world: Iterable[WorldState]) -> bool:
    """Whether somebody watched for contacts: there are some, or an engine that would have found them."""
    return bool(contacts) or any(finds_contacts(engine) for engine in {said.engine for said in world})


@dataclass(frozen=True)
class Goals:
    """Goals of one case, from the common start on.

    A robot's delay is from the measurement of its pose to the moment at which it acts on the first goal that rests on
    that pose: both ways through the network, and the wait for the next decision. Goals that rest on a pose that was
    answered before (a robot that has nothing new to say) have none.

    Attributes:
        time: (M,) when each was sent, since the common start [s].
        robot: (M,) row of its robot.
        bytes: (M,) size of the payload.
        reached: (N,) how many reached each robot.
        acted: (A,) when a first answer was acted on, since the common start [s].
        follower: (A,) row of its robot.
        delay: (A,) see above [s].
        heard: (N,) poses of each robot that the centre heard.
        lost: (N,) and those that never came, by their numbers.
        dropped: (N,) and those that the modelled network dropped.
        reports: What the centre said of itself, stamps in seconds since the common start; of no meaning in virtual
            time, where it takes no time.
    """

    time: Array
    robot: Index
    bytes: Index
    reached: Index
    acted: Array
    follower: Index
    delay: Array
    heard: Index
    lost: Index
    dropped: Index
    reports: tuple[messages.CentreState, ...] = ()


def _first(time: Array, row: Index, pose: Array) -> Mask:
    """Which of goals (K,), acted on at `time`, are the first of their robot that rest on that pose."""
    order = np.lexsort((time, row))
    changed = np.ones(len(order), dtype=bool)
    changed[1:] = (np.diff(row[order]) != 0) | (np.diff(pose[order]) > ROUNDING_S)
    first = np.zeros(len(order), dtype=bool)
    first[order] = changed
    return first


@dataclass(frozen=True)
class Sent:
    """Every pose that was sent, in order of time.

    Attributes:
        time: (M,) since the common start [s].
        robot: (M,) row of the sender.
        seq: (M,) running number per sender.
        position: (M, 3) as sent [m].
        velocity: (M, 3) as sent [m/s].
        yaw: (M,) as sent [rad].
        bytes: (M,) size of the payload.
    """

    time: Array
    robot: Index
    seq: Index
    position: Array
    velocity: Array
    yaw: Array
    bytes: Index


@dataclass(frozen=True)
class HeardPoses:
    """Every pose that was heard, in order of arrival.

    Attributes:
        time: (H,) arrival at the listener, since the common start [s].
        listener: (H,) row of the listener.
        speaker: (H,) row of the speaker.
        seq: (H,) the speaker's number.
        stamp: (H,) when the pose was taken, since the common start [s].
        position: (H, 3) as heard [m].
        velocity: (H, 3) as heard [m/s].
    """

    time: Array
    listener: Index
    speaker: Index
    seq: Index
    stamp: Array
    position: Array
    velocity: Array


@dataclass(frozen=True)
class Trace:
    """One case of a run.

    Attributes:
        case: Name of the case.
        experiment: The experiment of this case, overrides applied.
        seed: Seed of this run.
        robots: (N) names, in the order of the rows.
        clock: "real" or "virtual".
        time: (T,) common, uniform grid since the common start [s].
        position: (T, N, 3) measured [m].
        yaw: (T, N) measured [rad].
        true_position: (T, N, 3) the truth where there is one (twins), else as measured [m].
        goal: (T, N, 3) [m].
        setpoint: (T, N, 4) as sent to the body, see `agents.network.messages.State`.
        sent: Poses sent from the common start on.
        heard: Poses heard from the common start on.
        lost: (N,) samples of each robot that the sequence numbers prove were sent and that never came to a listener or
            the recorder; those that the modelled network dropped are not among them.
        missed_deadlines: (N,) ticks that began more than one period late.
        ticks: (N,) ticks in all, from the common start on.
        decisions: (N,) how often it computed its goal, from the common start on.
        events: What happened, stamps in seconds since the common start.
        interventions: (N,) ticks on which safety changed what had been decided, from the common start on.
        avoided: (N,) ticks on which avoidance did.
        contacts: What touched in the world from the common start to the end, stamps in seconds since then; None if
            nobody looked: there was no world, or its engine finds no contacts.
        world: What the world said of itself in that time, stamps in seconds since the common start.
        attitude: (T, N, 4) unit quaternions w, x, y, z from robot to room, NaN where unknown; None if none was told.
        shadow_position: (T, N, 3) of the twin beside each robot [m], NaN for robots without one; None if there is none.
        shadow_yaw: (T, N) of those twins [rad].
        dropped: (E,) samples that the modelled network dropped on each of `plan.heard_links`, in their order; None
            if that is not known.
        goals: What the centre told robots, and heard of them; None if every robot decides for itself.
        clocks: Of the other machines on which robots ran; what they stamped is set right by it.
    """

    case: str
    experiment: Experiment
    seed: int
    robots: tuple[str, ...]
    clock: str
    time: Array
    position: Array
    yaw: Array
    true_position: Array
    goal: Array
    setpoint: Array
    sent: Sent
    heard: HeardPoses
    lost: Index
    missed_deadlines: Index
    ticks: Index
    decisions: Index
    events: tuple[Event, ...]
    interventions: Index
    avoided: Index
    contacts: tuple[Contact, ...] | None = None
    world: tuple[WorldState, ...] = ()
    attitude: Array | None = None
    shadow_position: Array | None = None
    shadow_yaw: Array | None = None
    dropped: Index | None = None
    goals: Goals | None = None
    clocks: tuple[ClockOffset, ...] = ()

    @cached_property
    def plan(self) -> Plan:
        return Plan(self.experiment)
