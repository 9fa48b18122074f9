"""Robots and their twins in a run of virtual time, and one tick of all of them: quiet functions alone.

`experiments.virtual_time.simulation` lets a compiler run them for as long as nothing happens to a robot.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from math import inf, nan
from typing import Any, ClassVar, Final, Protocol

from agents.decision.neighbours import Neighbour
from agents.decision.stepping import Speech, Stepping
from agents.network.channel_model import ROUNDING_S, LinkChannel
from agents.robot import Robot
from agents.vectors import Pose, Vector
from experiments.virtual_time.records import MEASURES, numbers
from twins.body import Twin

WIDTH: Final = 20  # numbers of a robot in a sample
PLACES: Final = {  # first place of each in those
    "position": (0, 3), "velocity": (3, 6), "yaw": (6, 7), "true_position": (7, 10), "true_yaw": (10, 11),
    "goal": (11, 14), "setpoint": (14, 18), "error": (18, 19), "phase": (19, 20),
}  # fmt: skip
LEAN: Final = 3  # numbers of a true position alone
SENT: Final = 10  # numbers of a transmission
LEAN_SENT: Final = 3  # first of those, without the pose


class LinkQueue:
    """Link, with the samples that are on it."""

    __slots__ = ("arrivals", "channel", "first", "neighbour", "next", "samples", "sent", "size", "wide")

    neighbour: Neighbour  # the sender, as the receiver knows it
    channel: LinkChannel
    size: int  # samples for which there is room, and one more
    first: int  # index of the first sample
    next: int  # index behind the last one
    wide: int  # numbers of a sample
    sent: int  # count of the samples of a stretch
    arrivals: array[float]  # time of arrival of each [s], infinity for those that are lost
    # samples on the link, in the order of their arrivals: arrival [s], number, stamp [s], position [m], velocity [m/s],
    # yaw [rad] and words of each
    samples: array[float] | memoryview[float]

    def __init__(self, neighbour: Neighbour, channel: LinkChannel, size: int, words: int) -> None:
        """`words`: numbers beside a pose."""
        self.neighbour, self.channel, self.size = neighbour, channel, size
        self.first = self.next = self.sent = 0
        self.arrivals = array("d")
        self.wide = SENT + words
        self.samples = array("d", bytes(8 * self.wide * size))

    def put(  # noqa: PLR0917 - quiet
        self, arrival: float, seq: int, stamp: float, position: Vector, velocity: Vector, yaw: float,
        words: array[float],
    ) -> None:  # fmt: skip
        """A sample sets out; it may overtake others."""
        samples, wide, place = self.samples, self.wide, self.next
        self.next = (place + 1) % self.size
        assert self.next != self.first, "more samples on a link than there is room for"
        while place != self.first:
            before = (place - 1) % self.size
            if samples[before * wide] <= arrival:
                break
            for j in range(wide):
                samples[place * wide + j] = samples[before * wide + j]
            place = before
        k = place * wide
        samples[k], samples[k + 1] = arrival, float(seq)
        samples[k + 2] = stamp
        samples[k + 3], samples[k + 4], samples[k + 5] = position
        samples[k + 6], samples[k + 7], samples[k + 8] = velocity
        samples[k + 9] = yaw
        for j in range(self.wide - SENT):
            samples[k + SENT + j] = words[j]

    def deliver(self, t: float) -> None:
        """The receiver gets the samples that have arrived by `t` [s]."""
        samples, said = self.samples, numbers(self.neighbour.said)
        while self.first != self.next and samples[self.first * self.wide] <= t + ROUNDING_S:
            k, sender = self.first * self.wide, self.neighbour
            if samples[k + 2] > sender.stamp:
                sender.position = samples[k + 3], samples[k + 4], samples[k + 5]
                sender.velocity = samples[k + 6], samples[k + 7], samples[k + 8]
                sender.stamp, sender.arrival = samples[k + 2], samples[k]
                sender.yaw = samples[k + 9]
                for j in range(self.wide - SENT):
                    said[j] = samples[k + SENT + j]
            self.first = (self.first + 1) % self.size


class Member:
    """Robot with its twin, and the links on which it sends."""

    __slots__ = ("carrier", "moves", "robot", "row", "seq", "twin", "ways", "words")

    row: int
    moves: bool  # the phase of the robot moves on at this tick
    seq: int  # number of its last transmission
    robot: Robot
    twin: Twin
    carrier: Any  # hold of an engine on it, or None
    ways: list[LinkQueue]
    words: array[float]  # words of the last transmission

    def __init__(self, row: int, robot: Robot, twin: Twin, carrier: object, words: int) -> None:
        """`words`: numbers beside a pose."""
        self.row, self.robot, self.twin, self.carrier = row, robot, twin, carrier
        self.seq, self.ways = 0, []
        self.moves = False
        self.words = array("d", (nan,)) * words


class PlannedTargets:
    """Itinerary with targets that are known beforehand, one for each decision."""

    __slots__ = ("decide_hz", "first", "targets")

    first: int  # number of the decision of the first target
    decide_hz: float  # [1/s]
    targets: array[float]  # four numbers of each

    def __init__(self, decide_hz: float, decisions: int) -> None:
        self.first, self.decide_hz = 0, decide_hz
        self.targets = array("d", (nan,)) * (4 * decisions)

    def target(self, t: float, position: Vector, yaw: float) -> Pose:
        """As `Itinerary.target`, at the time of a decision."""
        k, targets = 4 * (round(t * self.decide_hz) - self.first), self.targets
        return targets[k], targets[k + 1], targets[k + 2], targets[k + 3]


class Ledger:
    """Notes of a run."""

    __slots__ = (
        "count", "ended", "laws", "lean", "memory", "moves", "rows", "sample", "samples", "sent", "start", "times",
        "wide",
    )  # fmt: skip

    lean: bool  # True for samples of true positions alone
    start: float  # common start [s], NaN before it is known
    ended: bool  # something happens to a robot
    moves: bool  # the phase of a robot moves on: its tick is done as far as poses are received
    count: int  # transmissions so far
    wide: int  # numbers of a transmission
    sent: array[float]  # row, number, time [s], position [m], velocity [m/s], yaw [rad] and words of each
    rows: int
    sample: int  # samples so far
    times: array[float]  # times of samples [s]
    samples: array[float]  # `WIDTH` numbers for each sample and robot, or `LEAN`
    memory: int  # most numbers of the memory of a law
    laws: array[float]  # memory and measures, see `Measured`, for each sample and robot

    def __init__(
        self, members: Sequence[Member], transmissions: int, samples: int, *, start: float, lean: bool
    ) -> None:
        """Ledger of `transmissions` of each member, and `samples`."""
        self.start = start
        self.rows = rows = len(members)
        self.lean, self.wide = lean, LEAN_SENT if lean else SENT + max(len(each.words) for each in members)
        self.count, self.sample = 0, 0
        self.ended = self.moves = False
        self.times = array("d", (0.0,)) * samples
        self.sent = array("d", (0.0,)) * (self.wide * transmissions * rows)
        memories = [each.robot.stepping.memory for each in members if each.robot.stepping is not None]
        self.memory = 0 if lean else max([sum(map(len, each.values())) for each in memories], default=0)
        self.laws = array("d", (0.0,)) * ((self.memory + 1 + MEASURES) * samples * rows * bool(memories))
        self.samples = array("d", (0.0,)) * ((LEAN if lean else WIDTH) * samples * rows)

    def note_sent(self, member: Member, t: float) -> None:
        robot, sent = member.robot, self.sent
        k = self.count * self.wide
        self.count += 1
        sent[k], sent[k + 1] = float(member.row), float(member.seq)
        sent[k + 2] = t
        if self.lean:
            return
        sent[k + 3], sent[k + 4], sent[k + 5] = robot.sent_position
        sent[k + 6], sent[k + 7], sent[k + 8] = robot.sent_velocity
        sent[k + 9] = robot.now.state.yaw
        for j in range(self.wide - SENT):
            sent[k + SENT + j] = member.words[j]

    def note_state(self, member: Member) -> None:
        """Note the state of a robot in the present sample."""
        robot, samples = member.robot, self.samples
        state = robot.now.state
        if robot.goals.stepping is not None:
            self.note_law(robot.goals.stepping, self.sample * self.rows + member.row)
        if self.lean:
            k = LEAN * (self.sample * self.rows + member.row)
            samples[k], samples[k + 1], samples[k + 2] = state.true_position
            return
        k = WIDTH * (self.sample * self.rows + member.row)
        samples[k], samples[k + 1], samples[k + 2] = state.position
        samples[k + 3], samples[k + 4], samples[k + 5] = state.velocity
        samples[k + 6], samples[k + 10] = state.yaw, state.true_yaw
        samples[k + 7], samples[k + 8], samples[k + 9] = state.true_position
        samples[k + 11], samples[k + 12], samples[k + 13] = robot.goal
        samples[k + 14], samples[k + 15], samples[k + 16], samples[k + 17] = robot.setpoint
        samples[k + 18], samples[k + 19] = robot.error, float(robot.lifecycle.phase)

    def note_law(self, stepping: Stepping, row: int) -> None:
        """Note what a law remembers and measures, as one row of `laws`."""
        k, laws = (self.memory + 1 + MEASURES) * row, self.laws
        if not self.lean:
            for j, value in enumerate(numbers(stepping.memory)):
                laws[k + j] = value
        for j, value in enumerate(numbers(stepping.measures)):
            laws[k + self.memory + j] = value


class Stage:
    """The world that robots share: its engine moves them together, in Python."""

    IN_PYTHON: ClassVar = ("advance",)

    def __init__(self, rows: int) -> None:
        self.rows = rows  # number of robots

    def advance(self, t: float) -> None:
        """All robots move on to `t` [s]; see `experiments.virtual_time.steps`."""
        raise TypeError(t)


class Display(Protocol):
    """Place where the robots are shown at the end of a stretch; see `experiments.learning.window`."""

    def place(self, robot: Robot, row: int, sent: int) -> None:
        """Note the place of a robot, of which `sent` is the number of its last transmission."""
        ...

    def show(self, robot: Robot, row: int, t: float) -> None:
        """Show a robot at `t` [s], once the places of all are noted."""
        ...

    def is_of(self, t: float) -> bool:
        """Whether all robots are shown as they are at `t` [s]; not quiet."""
        ...


class Crew:
    """Members, those of the same layout in lists g0, g1, ..., their world if they share one, and notes of a stretch."""

    ledger: Ledger
    stage: Stage | None
    window: Display | None

    def __init__(
        self, groups: Sequence[list[Member]], ledger: Ledger, stage: Stage | None, window: Display | None
    ) -> None:
        self.ledger, self.stage = ledger, stage
        self.window = window
        for k, group in enumerate(groups):
            setattr(self, f"g{k}", group)


def advance(members: list[Member], t: float, dt: float) -> None:
    """Twins move on to `t` [s], and measure."""
    for member in members:
        member.twin.advance(t, dt)
        member.twin.measure(member.robot.now.state)


def begin_step(members: list[Member]) -> None:
    """First part of a step in a world."""
    for member in members:
        member.twin.begin_step()
        if member.carrier is not None:
            member.carrier.push(member.twin.motion)


def end_step(members: list[Member], t: float, dt: float) -> None:
    """Last part of a step in a world to `t` [s], behind its engine's."""
    for member in members:
        if member.carrier is not None:
            member.carrier.take(member.twin.motion)
        member.twin.end_step(t, dt)
        member.twin.measure(member.robot.now.state)


def deliver(members: list[Member], t: float) -> None:
    """Poses that have arrived by `t` [s] are received."""
    for member in members:
        for way in member.ways:
            way.deliver(t)


def observe(members: list[Member], t: float) -> bool:
    """Robots take the states of their bodies; returns whether the phase of one moves on."""
    moves = False
    for member in members:
        member.robot.observe(t)
        member.moves = not member.robot.is_steady(t)
        moves = moves or member.moves
    return moves


def transmit(members: list[Member], t: float, ledger: Ledger) -> None:
    """First half of the decisions."""
    for member in members:
        robot = member.robot
        if robot.transmission_due(t):
            member.seq += 1
            speech = robot.transmitter.speech
            if speech is not None:
                speak(speech, member.words)
            ledger.note_sent(member, t)
            for way in member.ways:
                arrival = way.channel.arrival(member.seq, t, t - ledger.start, 0)
                if not ledger.lean:
                    way.arrivals[way.sent] = arrival
                way.sent += 1
                if arrival < inf:
                    way.put(
                        arrival, member.seq, t, robot.sent_position, robot.sent_velocity, robot.now.state.yaw,
                        member.words,
                    )  # fmt: skip


def speak(speech: Speech, words: array[float]) -> None:
    """Words of a transmission, NaN for a variable that is not said."""
    k = 0
    for name in speech.metres:
        says = speech.says(name)
        for value in speech.said[name]:
            words[k] = value if says else nan
            k += 1


def detect(members: list[Member], t: float) -> bool:
    """Causes of hazards; returns whether a robot has any."""
    found = False
    for member in members:
        if member.robot.detect(t):
            found = True
    return found


def pursue(members: list[Member], t: float) -> None:
    """Second half of the decisions of robots without hazards, and commands to their twins."""
    for member in members:
        robot = member.robot
        robot.pursue(t, False)
        member.twin.command(robot.setpoint)


def note(members: list[Member], ledger: Ledger) -> None:
    """Note the states of these robots."""
    for member in members:
        ledger.note_state(member)


def place(members: list[Member], window: Display) -> None:
    """Note the places of these robots in a window."""
    for member in members:
        window.place(member.robot, member.row, member.seq)


def show(members: list[Member], window: Display, t: float) -> None:
    """Show these robots at `t` [s]."""
    for member in members:
        window.show(member.robot, member.row, t)
