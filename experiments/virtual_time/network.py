"""The network of a virtual run: poses between robots, poses and goals of the central controller, and their log."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from math import inf, nan
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from agents.decision.centralised import Centre
from agents.decision.neighbours import NO_WORDS
from agents.decision.stepping import Words
from agents.network import messages
from agents.network.channel_model import ROUNDING_S, Channel
from agents.robot import Robot
from agents.vectors import ZERO, Vector
from experiments.arrays import PoseTable
from experiments.definition.link_conditions import FROM_CENTRE, TO_CENTRE, conditions_of
from experiments.definition.plan import Plan
from experiments.recording.trace import EPOCH
from experiments.virtual_time.steps import words_of
from experiments.virtual_time.tick import SENT, Ledger, LinkQueue
from twins.arrays import Array, Index


class Sample(NamedTuple):
    """Pose, or goal of the central controller, on its way."""

    row: int  # robot that sent it; of a goal, the robot that it is for
    seq: int
    stamp: float  # [s]
    position: Vector  # [m]
    velocity: Vector  # [m/s]
    yaw: float  # [rad]
    pose: float = nan  # stamp of the pose on which a goal rests [s]
    words: Words = ()  # what is said beside a pose


Arrived = tuple[int, float, Sample]  # link, arrival [s]


@dataclass(frozen=True)
class CentreLog:
    """Messages between robots and the central controller, in the time of the experiment [s].

    `link` is the row of the robot in each table.
    """

    sent: PoseTable  # goals; `extra` is the stamp of the pose on which each rests
    followed: PoseTable  # goals that robots acted on (`arrival`), with the same `extra`
    received: PoseTable  # poses, as the central controller received them
    lost_poses: Index  # (N,) of each robot, from the common start to the end of the experiment


class VirtualCentre:
    """The central controller. Its poses and goals have the delays and losses of poses between robots.

    Phases and the common start are the conductor's; the centre and the robots know them at once.
    """

    def __init__(self, plan: Plan, robots: Sequence[Robot], seed: int) -> None:
        names = plan.names
        self.centre = Centre([plan.assignment(name, centrally=True) for name in names])
        self._robots, self._needed = robots, self.centre.needed
        for row in self._needed:
            self.centre.mark_alive(row)  # all robots are there from the beginning
        self._guided = [row for row, robot in enumerate(robots) if robot.guidance is not None]
        self._poses, self._goals = (
            Channel(conditions_of(plan, [(names[row], names[row]) for row in rows], seed, stream=stream))
            for rows, stream in ((self._needed, TO_CENTRE), (self._guided, FROM_CENTRE))
        )
        self._link_of = {row: link for link, row in enumerate(self._needed)}
        self._goal_link = {row: link for link, row in enumerate(self._guided)}
        self._seq = [0] * len(robots)
        self._plan = plan
        self._sent, self._followed = _Samples(1), _Samples(1)
        self._received = _Samples()
        self.instant = self._goals.instant  # goals are received within the tick

    def transmit(self, sample: Sample, start: float, size: int) -> None:
        """A robot transmits its pose to the central controller; see `VirtualNetwork.transmit`."""
        if (link := self._link_of.get(sample.row)) is not None:
            self._poses.send(link, sample, sample.seq, sample.stamp, start=start, size=size)

    def deliver(self, t: float) -> None:
        """Delivers at `t` [s]: poses to the central controller, goals to the robots."""
        for link, arrival, sample in self._poses.due(t):
            row = self._needed[link]
            self.centre.receive(row, sample.position, sample.velocity, sample.stamp, arrival, yaw=sample.yaw)
            self._received.add(row, arrival, sample)
        newest = {link: sample for link, _, sample in sorted(self._goals.due(t), key=lambda each: each[2].stamp)}
        for link, sample in sorted(newest.items()):  # the newest of several for one robot counts
            row = self._guided[link]
            guidance = self._robots[row].guidance
            assert guidance is not None
            if guidance.receive(sample.position, sample.yaw, sample.stamp, sample.velocity):
                self._followed.add(row, t, sample, (sample.pose,))

    def retire(self, row: int, t: float) -> None:
        """A robot is lost to the central controller at `t` [s]; see `VirtualNetwork.retire`."""
        if (link := self._link_of.get(row)) is not None:
            self._poses.forget(link)
            self.centre.mark_lost(row, t)

    def decide(self, t: float) -> None:
        """On a tick on which goals are decided: those of the robots that are guided."""
        lives = [robot.lifecycle for robot in self._robots]
        starts = [life.start_at for life in lives]
        for followed, robot in zip(self.centre.robots, self._robots, strict=True):
            followed.held = robot.hazards.held
        for goal in self.centre.decide(t, [life.phase for life in lives], starts):
            row = goal.row
            self._seq[row] += 1
            sample = Sample(row, self._seq[row], t, goal.goal, goal.velocity, goal.yaw, goal.pose_stamp)
            size = _size(self._plan, sample._replace(velocity=ZERO), min(starts)) if self._goals.limited else 0
            self._goals.send(self._goal_link[row], sample, sample.seq, t, start=min(starts), size=size)
            self._sent.add(row, t, sample, (sample.pose,))

    def logged(self, begin: float) -> CentreLog:
        """The log, with times since the common start at `begin` [s]."""
        lost = np.zeros(len(self._seq), dtype=np.intp)
        lost[self._needed] = self._poses.dropped
        goals = (self._sent.table(begin), self._followed.table(begin, bare=True))
        sent, followed = (replace(each, extra=each.extra - begin) for each in goals if each.extra is not None)
        return CentreLog(sent, followed, self._received.table(begin, bare=True), lost)


def _size(plan: Plan, sample: Sample, start: float) -> int:
    """Bytes of a pose, as a real network carries it; `start` is the common start [s]."""
    name, stamp = plan.names[sample.row], EPOCH + (sample.stamp - start if sample.stamp >= start else 0.0)
    pose = messages.pose(name, sample.seq, stamp, sample.position, sample.velocity, yaw=sample.yaw, words=sample.words)
    return len(messages.encode(pose, plan.experiment.network.encoding))


class VirtualNetwork:
    """Carries poses between robots, and poses and goals between them and their centre, if they have one."""

    def __init__(self, plan: Plan, robots: Sequence[Robot], seed: int, *, lean: bool) -> None:
        """Network of all robots; `lean` as for `experiments.virtual_time.simulation.simulate`."""
        self._plan, self._robots, self._lean = plan, robots, lean
        ends = [(sender.name, robot.assignment.name) for robot in robots for sender in robot.neighbours.all]
        self._channel = Channel(conditions_of(plan, ends, seed))
        # by link: the robot that receives on it, and the number among its links
        self.receivers = [(robot, k) for robot in robots for k in range(len(robot.neighbours.all))]
        self._links: list[list[int]] = [[] for _ in robots]  # links on which each robot is the sender
        for link, (robot, k) in enumerate(self.receivers):
            self._links[robot.neighbours.all[k].sender].append(link)
            robot.neighbours.mark_alive(k)  # all robots are there from the beginning
        guided = any(robot.guidance is not None for robot in robots)
        self.centre = VirtualCentre(plan, robots, seed) if guided else None
        self.seq = [0] * len(robots)  # number of the last pose of each robot
        self.retired: set[int] = set()  # robots that are silent
        # names and sizes of the variables that they say
        self.says = {} if robots[0].stepping is None else robots[0].stepping.says
        self._sent, self._received = _Samples(0 if lean else sum(self.says.values())), _Samples()
        self.instant = self._channel.instant  # poses that are transmitted are received within the tick
        self.channels = self._channel.links
        self.is_quiet = self.centre is None and not self._channel.limited  # nothing asks for sizes of messages

    def transmit(self, row: int, robot: Robot, t: float, yaw: float, start: float) -> None:
        """A robot transmits its pose at `t` [s]. Before the common start at `start` [s] nothing is lost."""
        self.seq[row] += 1
        seq, channel = self.seq[row], self._channel
        sample = Sample(row, seq, t, robot.sent_position, robot.sent_velocity, yaw, words=robot.words)
        self._sent.add(row, t, sample, () if self._lean else self._numbers(robot.words))
        size = _size(self._plan, sample, start) if channel.limited else 0
        for link in self._links[row]:
            channel.send(link, sample, seq, t, start=start, size=size)
        if self.centre is not None:
            self.centre.transmit(sample, start, size)

    def _numbers(self, words: Words) -> tuple[float, ...]:
        """Numbers of all variables, NaN of those that are not said."""
        said = {name: (nan,) * size for name, size in self.says.items()} | dict(words)
        return tuple(chain.from_iterable(said.values()))

    def retire(self, row: int, t: float) -> None:
        """A robot lands at `t` [s] in mid-run: it is silent, and lost to the others, none of which follows it down."""
        self.retired.add(row)
        for link in self._links[row]:
            robot, k = self.receivers[link]
            self._channel.forget(link)
            robot.neighbours.mark_lost(k, t)
        if self.centre is not None:
            self.centre.retire(row, t)

    def deliver(self, t: float) -> None:
        """Delivers poses and goals that have arrived by `t` [s]."""
        for link, arrival, sample in self._channel.due(t):
            robot, k = self.receivers[link]
            robot.neighbours.receive(
                k,
                sample.position,
                sample.velocity,
                sample.stamp,
                arrival,
                yaw=sample.yaw,
                said=dict(sample.words) if sample.words else NO_WORDS,
            )
            if not self._lean:
                self._received.add(link, arrival, sample)
        if self.centre is not None:
            self.centre.deliver(t)

    def logged(self, begin: float) -> dict[str, Any]:
        """Columns of the log, see `experiments.virtual_time.simulation.Log`; the common start is at `begin` [s]."""
        return {
            "sent": self._sent.table(begin, bare=self._lean),
            "says": self.says,
            "received": self._received.table(begin, ordered=True),
            "lost": np.array(self._channel.dropped, dtype=np.intp),
            "centre": None if self.centre is None else self.centre.logged(begin),
        }

    # ------------------------------------------------------------------ compiled stretches

    def board(self, ways: Sequence[LinkQueue]) -> list[Arrived]:
        """Hand all samples that are under way to the `ways` of their links; returns them."""
        under_way = self._channel.due(inf)
        for way in ways:
            way.first = way.next = way.sent = 0
        for link, arrival, sample in under_way:
            words = array("d", self._numbers(sample.words))
            ways[link].put(arrival, sample.seq, sample.stamp, sample.position, sample.velocity, sample.yaw, words)
        return under_way

    def leave(self, ways: Sequence[LinkQueue], ledger: Ledger, before: Sequence[Arrived], t: float) -> None:
        """Take over what robots sent until `t` [s], by their ledger, and what was received of it and of `before`."""
        under_way = []
        for link, way in enumerate(ways):
            robot, number = self.receivers[link]
            while way.first != way.next:
                k, row = way.first, robot.neighbours.all[number].sender
                arrival, seq, stamp, x, y, z, vx, vy, vz, yaw, *said = way.samples[k * way.wide : (k + 1) * way.wide]
                pose = Sample(row, int(seq), stamp, (x, y, z), (vx, vy, vz), yaw, words=words_of(self.says, said))
                under_way.append((stamp, row, link, arrival, pose))
                way.first = (k + 1) % way.size
        for _, _, link, arrival, sample in sorted(under_way, key=itemgetter(0, 1, 2)):  # same order as they were sent
            self._channel.put(link, arrival, sample)
        sent = np.frombuffer(ledger.sent)[: ledger.count * ledger.wide].reshape(-1, ledger.wide)
        rows, times = sent[:, 0], sent[:, 2]
        if np.any((rows[1:] < rows[:-1]) & (times[1:] <= times[:-1])):  # robots of a kind are flown together
            sent = sent[np.lexsort((rows, times))]
        sent, words = sent[:, :SENT], sent[:, SENT:]
        self._sent.extend(sent, sent[:, 2], sent[:, 0].astype(np.intp))
        if self.says and not self._lean:
            self._sent.extra += words.tolist()
        if not self._lean:
            self._receive_all(ways, sent, before, t)

    def _receive_all(self, ways: Sequence[LinkQueue], sent: Array, before: Sequence[Arrived], t: float) -> None:
        """Note what was received until `t` [s] of what was `sent` (K, 10), and of what was under way `before`."""
        first = np.array([_row(sample) for _, _, sample in before]).reshape(-1, SENT)
        links = [np.array([link for link, _, _ in before], dtype=np.intp)]
        arrivals = [np.array([arrival for _, arrival, _ in before], dtype=float)]
        rows = [np.arange(len(first))]
        order = np.argsort(sent[:, 0], kind="stable")
        begins = np.searchsorted(sent[order, 0], np.arange(len(self._robots) + 1)).tolist()
        for link, (robot, k) in enumerate(self.receivers):
            sender = robot.neighbours.all[k].sender
            which = order[begins[sender] : begins[sender + 1]]
            rows.append(len(first) + which)
            links.append(np.full(len(which), link))
            arrivals.append(np.array(ways[link].arrivals[: len(which)]))
        arrival = np.concatenate(arrivals)
        known = arrival <= t + ROUNDING_S
        on, every = np.concatenate(links)[known], np.concatenate(rows)[known]
        self._received.extend(np.concatenate([first, sent]), arrival[known], on, every)


def _row(sample: Sample) -> tuple[float, ...]:
    """Numbers of a sample, as `Ledger.sent` has them."""
    return (float(sample.row), float(sample.seq), sample.stamp, *sample.position, *sample.velocity, sample.yaw)


class _Samples:
    """Samples with their links and arrivals, in the order in which they were noted."""

    def __init__(self, extra: int = 0) -> None:
        """`extra`: how many more numbers each sample has."""
        # link (K,), arrival (K,) [s], and numbers of samples (M, 10), with the row of each in them (K,)
        self._parts: list[tuple[Index, Array, Array, Index | slice]] = []
        self._last: list[tuple[float, ...]] = []
        self._width, self.extra = extra, list[Sequence[float]]()

    def add(self, link: int, arrival: float, sample: Sample, extra: tuple[float, ...] = ()) -> None:
        self._last.append((float(link), arrival, *_row(sample)))
        if extra:
            self.extra.append(extra)

    def extend(self, samples: Array, arrival: Array, link: Index, which: Index | slice = slice(None)) -> None:
        """Add samples with their `arrival` (K,) [s] and `link` (K,): those rows `which` (K,) of `samples` (M, 10)."""
        self._settle()
        self._parts.append((link, arrival, samples, which))

    def _settle(self) -> None:
        if self._last:
            rows, self._last = np.array(self._last), []
            self._parts.append((rows[:, 0].astype(np.intp), rows[:, 1], rows[:, 2:], slice(None)))

    def table(self, begin: float, *, bare: bool = False, ordered: bool = False) -> PoseTable:
        """A table with times since the common start at `begin` [s].

        Args:
            bare: Numbers and times alone.
            ordered: In the order of a recording, and without yaws.
        """
        self._settle()
        link, arrival = (np.concatenate([np.zeros(0), *(part[k] for part in self._parts)]) for k in (0, 1))
        order: Index | slice = np.lexsort((link, arrival - begin)) if ordered else slice(None)

        def column(what: int | slice) -> Array:
            parts = [samples[which, what] for *_, samples, which in self._parts]
            return np.concatenate([np.zeros((0, SENT))[:, what], *parts])[order]

        nothing = np.zeros((len(link), 0))
        return PoseTable(
            link[order].astype(np.intp),
            column(1).astype(np.intp),
            column(2) - begin,
            arrival[order] - begin,
            nothing if bare else column(slice(3, 6)),
            nothing if bare else column(slice(6, 9)),
            None if bare or ordered else column(9),
            extra=np.array(self.extra).reshape(-1, self._width) if self._width else None,
        )
