"""What happened in one case of a run, as arrays; made by the virtual clock, or read back from a recording."""

from __future__ import annotations

from dataclasses import dataclass

from agents.rows import Array, Index
from agents.wire import Contact, Event, WorldState
from experiments.clocks import Lie
from experiments.experiment import Experiment
from experiments.goals import Goals


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
        setpoint: (T, N, 4) as sent to the body, see `agents.wire.State`.
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
        dropped: (E,) samples that the modelled network dropped on each of `assign.heard_links`, in their order; None
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
    clocks: tuple[Lie, ...] = ()
