"""The log of a virtual run as traces and as recordings, which are those of a real run."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from itertools import accumulate, cycle, pairwise, repeat
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from agents.decision.lifecycle import FINISHED, SCRIPTED, Phase
from agents.network import messages
from agents.safety.hazards import Outcome
from agents.ticks import ROUNDING_S
from experiments.arrays import PoseTable, rounded
from experiments.definition.experiment import WALL
from experiments.definition.graph import Links
from experiments.definition.plan import Plan
from experiments.recording.topics import Message
from experiments.recording.trace import (
    EPOCH,
    OPTIONAL,
    Goals,
    Trace,
    poses_in_run,
    world_in_run,
)
from experiments.recording.writer import Recording
from experiments.scene import markers
from experiments.virtual_time.network import CentreLog
from experiments.virtual_time.simulation import VirtualRunLog
from twins.arrays import Array, Index

SAMPLED: Final = ("position", "yaw", "true_position", "goal", "setpoint")  # columns of a log that a trace has as well
MANY_ROWS: Final = 10_000
LARGE_CHUNK_BYTES: Final = 512 * 1024  # size for a run that is over: there is nothing to be lost by a kill


class RunRecorder:
    """Virtual run as a trace or a recording."""

    def __init__(self, log: VirtualRunLog, plan: Plan, case: str) -> None:
        self._log, self._plan, self._case = log, plan, case
        self._experiment, self._scene = plan.experiment, plan.scene
        self._links: Links = plan.pose_links

    @cached_property
    def goals(self) -> Goals | None:
        """Goals of the central controller; None if each robot decides for itself."""
        centre, rows = self._log.centre, len(self._log.names)
        if centre is None:
            return None
        sizes = [len(messages.encode(goal, self._encoding)) for _, goal in self._goal_messages(centre)]
        received = poses_in_run(centre.received, self._experiment.duration_s, "arrival")
        return Goals.of_run(
            replace(centre.sent, bytes=np.array(sizes, dtype=np.intp)),
            centre.followed,
            self._experiment.duration_s,
            received=np.bincount(received.link, minlength=rows),
            lost=np.zeros(rows, dtype=np.intp),
            dropped=centre.lost_poses,
        )

    def trace(self) -> Trace:
        """The run from the common start on, as arrays."""
        log, duration = self._log, self._experiment.duration_s
        begin, end = np.searchsorted(log.time, -ROUNDING_S), np.searchsorted(log.time, duration + ROUNDING_S, "right")
        run = slice(int(begin), int(end))  # a part of the log, no copy
        rows, sent = len(log.names), poses_in_run(log.sent, duration, "stamp")
        if not log.lean:
            sizes = [len(messages.encode(pose, self._encoding)) for pose in self._poses(sent)]
            sent = replace(sent, bytes=np.array(sizes, dtype=np.intp))
        contacts, world = world_in_run(self._contacts(), self._world(), EPOCH, duration)
        columns: dict[str, Any] = {what: getattr(log, what) for what in (*SAMPLED, *OPTIONAL)}
        columns = {what: None if each is None else each[run] for what, each in columns.items()}
        return Trace(
            case=self._case,
            plan=self._plan,
            seed=self._log.seed,
            robots=log.names,
            clock="virtual",
            time=np.round(log.time[run], 9),
            sent=sent,
            received=poses_in_run(self._log.received, duration, "arrival"),
            lost=np.zeros(rows, dtype=np.intp),
            missed_deadlines=np.zeros(rows, dtype=np.intp),
            ticks=np.full(rows, log.ticks, dtype=np.intp),
            decisions=log.updates,
            events=tuple(
                messages.Event(t, kind, source, text) for t, kind, source, text in self._events() if t <= duration
            ),
            interventions=log.interventions,
            avoided=log.avoided,
            contacts=contacts,
            world=world,
            dropped=self._log.lost,
            foreign=np.zeros(len(log.names), dtype=np.intp),
            goals=None if log.lean else self.goals,
            memory={name: values[run] for name, values in log.memory.items()},
            measures={name: values[run] for name, values in log.measures.items()},
            **columns,
        )

    def record(self, path: Path, document: str) -> None:
        """Writes a recording of the whole run, take-off and landing included."""
        with Recording(
            path,
            self._plan,
            document,
            case=self._case,
            seed=self._log.seed,
            clock="virtual",
            started=EPOCH,
            draw=markers.drawing(self._plan),
            chunk_bytes=LARGE_CHUNK_BYTES,
        ) as recording:
            for message in heapq.merge(*self._messages(), key=attrgetter("stamp")):
                recording.write(message)

    def _messages(self) -> Iterator[Iterable[Message]]:
        """All messages, those of a kind in order of time."""
        yield [messages.Event(EPOCH + t, *said) for t, *said in self._events()]
        yield self._poses(self._log.sent)
        yield self._memories()
        yield self._states()
        if self._log.centre is not None and self.goals is not None:
            yield (goal for _, goal in self._goal_messages(self._log.centre))
            yield [self._centre_report(self.goals)]
        for rare in (self.statuses(), self._world(), self._contacts()):
            yield sorted(rare, key=attrgetter("stamp"))

    @property
    def _encoding(self) -> messages.Encoding:
        return self._experiment.network.encoding

    def _poses(self, sent: PoseTable) -> Iterator[messages.Pose]:
        """Poses as `messages.pose` makes them."""
        for begin in range(0, len(sent), MANY_ROWS):
            part = sent.take(slice(begin, begin + MANY_ROWS))
            assert part.yaw is not None
            yield from map(
                messages.Pose,
                [self._log.names[row] for row in part.link.tolist()],
                part.seq.tolist(),
                rounded(EPOCH + part.stamp).tolist(),
                rounded(part.position).tolist(),
                _values(rounded(part.velocity)),
                _values(rounded(_headings(part.yaw))),
                self._shared(part),
            )

    def _shared(self, sent: PoseTable) -> Iterable[list[messages.Variable]]:
        """Variables transmitted with each pose."""
        if sent.extra is None:
            return repeat([])
        ends = accumulate(self._log.says.values(), initial=0)
        spans = list(zip(self._log.says, pairwise(ends), strict=True))
        return (messages.variables((name, row[i:j]) for name, (i, j) in spans) for row in sent.extra.tolist())

    def _memories(self) -> Iterator[messages.LawMemory]:
        """Memory and measures of the laws at each sample."""
        log = self._log
        for k, t in enumerate(log.time.tolist() if log.memory or log.measures else ()):
            for row, name in enumerate(log.names):
                memory = {what: values[k, row].tolist() for what, values in log.memory.items()}
                measures = {what: float(values[k, row]) for what, values in log.measures.items()}
                yield messages.memory(name, k + 1, EPOCH + t, memory, measures)

    def _goal_messages(self, centre: CentreLog) -> Iterator[tuple[float, messages.Goal]]:
        """Goals, and when they were sent since the common start [s]."""
        own, names = centre.sent, self._log.names
        assert own.yaw is not None
        assert own.extra is not None
        columns = (own.stamp, own.link, own.seq, own.position.round(6), own.yaw.round(6), own.extra[:, 0], own.velocity)
        for t, robot, number, place, yaw, pose, way in zip(*(column.tolist() for column in columns), strict=True):
            sent, taken = round(EPOCH + t, 6), round(EPOCH + pose, 6)
            heading = None if math.isnan(yaw) else yaw
            yield t, messages.Goal(names[robot], number, sent, tuple(place), heading, taken, messages.wanted(way))

    def _centre_report(self, goals: Goals) -> messages.CentreState:
        """The report of the central controller at the end of the run."""
        names = self._log.names
        return messages.CentreState(
            stamp=EPOCH + self._experiment.duration_s,
            robots=[name for name, reached in zip(names, goals.reached, strict=True) if reached],
            decisions=len(np.unique(goals.sent.stamp)),
            goals=len(goals.sent),
            received=dict(zip(names, goals.received.tolist(), strict=True)),
            lost=dict.fromkeys(names, 0),
            dropped=dict(zip(names, goals.dropped.tolist(), strict=True)),
        )

    def _states(self) -> Iterator[messages.State]:
        """Telemetry, with the poses and goals that each robot received since its sample before."""
        log, rows = self._log, len(self._log.names)
        words = np.array([phase.word for phase in Phase])
        received, receipts = self._received(), self._goal_receipts()
        for begin in range(0, len(log.time), max(1, MANY_ROWS // rows)):
            part = slice(begin, begin + max(1, MANY_ROWS // rows))
            sample = np.repeat(np.arange(len(log.time))[part], rows)

            def values(column: Array | None, part: slice = part) -> Iterable[Any]:
                return repeat(None) if column is None else _values(column[part].reshape(-1, *column.shape[2:]))

            yield from map(
                messages.State,
                cycle(log.names),
                (sample + 1).tolist(),
                (EPOCH + log.time[sample]).tolist(),
                words[log.phase[part]].ravel().tolist(),
                values(log.position),
                values(log.velocity),
                values(_headings(log.yaw)),
                values(log.goal),
                values(log.setpoint),
                log.error[part].ravel().tolist(),
                values(log.true_position),
                values(_headings(log.true_yaw)),
                received(part),
                values(log.attitude),
                values(log.shadow_position),
                values(log.shadow_yaw),
                receipts(part),
            )

    def _received(self) -> Callable[[slice], Iterable[list[Any]]]:
        """Receipts as they are encoded: several robots receive the same pose at the same time."""
        names, got = self._log.names, self._log.received
        sender = self._links.sender[got.link]
        arrivals = np.unique(got.arrival, return_inverse=True)[1]
        same = (arrivals * len(names) + sender) * (got.seq.max(initial=0) + 1) + got.seq

        def receipts(at: Index) -> list[msgspec.Raw]:
            _, first, which = np.unique(same[at], return_index=True, return_inverse=True)
            each = got.take(at[first])
            made = map(
                messages.PoseReceipt,
                [names[row] for row in sender[at[first]].tolist()],
                each.seq.tolist(),
                (EPOCH + each.stamp).tolist(),
                (EPOCH + each.arrival).tolist(),
                each.position.tolist(),
                each.velocity.tolist(),
            )
            encoded = [msgspec.Raw(messages.encode(receipt, self._encoding)) for receipt in made]
            return [encoded[k] for k in which.tolist()]

        return self._by_sample(got.arrival, self._links.receiver[got.link], receipts)

    def _goal_receipts(self) -> Callable[[slice], Iterable[list[Any]]]:
        if self._log.centre is None:
            return lambda _: repeat([])
        got = self._log.centre.followed
        assert got.extra is not None
        times = EPOCH + np.column_stack([got.stamp, got.extra[:, 0], got.arrival])
        return self._by_sample(
            got.arrival, got.link, lambda at: map(messages.GoalReceipt, got.seq[at].tolist(), *times[at].T.tolist())
        )

    def _by_sample(
        self, arrival: Array, row: Index, receipts: Callable[[Index], Iterable[Any]]
    ) -> Callable[[slice], Iterable[list[Any]]]:
        """Function of some samples: receipts of each robot at each of them, since the sample before."""
        rows, samples = len(self._log.names), len(self._log.time)
        key = np.searchsorted(self._log.time, arrival - ROUNDING_S) * rows + row
        order = np.argsort(key, kind="stable")
        bounds = np.searchsorted(key[order], np.arange(samples * rows + 1))

        def of(part: slice) -> Iterable[list[Any]]:
            ends = bounds[part.start * rows : part.stop * rows + 1]
            found = list(receipts(order[ends[0] : ends[-1]]))
            return [found[i:j] for i, j in pairwise((ends - ends[0]).tolist())]

        return of

    def statuses(self) -> Iterator[messages.Status]:
        """The counters at the end of the run and at the end of everything."""
        log = self._log
        receiver = self._links.receiver[log.received.link]
        early = [each.lands_at_s or math.inf for each in self._experiment.robots.values()]
        ends = {row: SCRIPTED for row, at in enumerate(early) if at < self._experiment.duration_s}
        ends |= {row: each.text for row, each in log.incidents if each.outcome >= Outcome.LAND}
        for end, phase, until in ((self._experiment.duration_s, "landing", ROUNDING_S), (log.ended, "done", math.inf)):
            sent = np.bincount(log.sent.link[log.sent.stamp <= end + until], minlength=len(log.names))
            received = np.bincount(receiver[log.received.arrival <= end + until], minlength=len(log.names))
            for row, name in enumerate(log.names):
                incoming = self._links.receiver == row
                each = zip(self._links.sender[incoming].tolist(), self._log.lost[incoming].tolist(), strict=True)
                yield messages.Status(
                    robot=name,
                    stamp=EPOCH + end,
                    phase=phase,
                    reason=ends.get(row, FINISHED),
                    sent=int(sent[row]),
                    received=int(received[row]),
                    lost={log.names[s]: 0 for s in self._links.sender[incoming].tolist()},
                    dropped={log.names[s]: n for s, n in each if n},
                    ticks=log.ticks,
                    decisions=int(log.updates[row]),
                    interventions=int(log.interventions[row]),
                    avoided=int(log.avoided[row]),
                    started=EPOCH,
                )

    def _contacts(self) -> Iterator[messages.Contact]:
        """Contacts, take-off and landing included."""
        names = self._log.names
        for touch in self._log.touches:
            other = names[touch.second] if touch.second >= 0 else (*self._scene.names, WALL)[-1 - touch.second]
            yield messages.Contact(
                EPOCH + touch.time, names[touch.first], other, float(touch.impulse), float(touch.overlap)
            )

    def _world(self) -> Iterator[messages.WorldState]:
        """Reports of a world at 1 Hz; none where robots are alone in an empty place."""
        log, scene = self._log, self._scene
        if log.lean or not (scene.names or log.touches or self._plan.finds_contacts):
            return
        touched = np.sort([contact.stamp - EPOCH for contact in self._contacts()])
        whole = np.flatnonzero(np.abs(log.time - np.round(log.time)) < 0.5 / self._experiment.rates.state_hz - 1e-9)
        for k in whole.tolist():
            t = float(log.time[k])
            yield messages.WorldState(
                stamp=EPOCH + t,
                engine=self._plan.engine_name,
                time=t - float(log.time[0]),
                factor=1.0,
                load=0.0,
                paused=False,
                robots=list(log.names),
                obstacles=[
                    messages.ObstaclePose(*each)
                    for each in zip(scene.names, map(tuple, log.obstacles[k].tolist()), strict=True)
                ],
                contacts=int(np.searchsorted(touched, t, side="right")),
            )

    def _events(self) -> Iterator[tuple[float, str, str, str]]:
        """Events of the conductor and hazards, in order of time."""
        names = self._log.names
        hazards = ((each.time, "hazard", names[row], each.text) for row, each in self._log.incidents)
        yield from sorted([*self._conducted(), *hazards], key=lambda event: event[0])

    def _conducted(self) -> Iterator[tuple[float, str, str, str]]:
        yield self._log.airborne, "phase", "conductor", "airborne"
        yield 0.0, "start", "conductor", "common start"
        yield from ((at, "phase", "conductor", name) for at, name in self._experiment.phases)
        yield self._experiment.duration_s, "phase", "conductor", "landing"


def _values(column: Array) -> list[Any]:
    """Values of a column for messages: None for a number or vector that is not finite."""
    values: list[Any] = column.tolist()
    known = np.isfinite(column)
    for k in np.flatnonzero(~(known if known.ndim == 1 else known.all(axis=1))).tolist():
        values[k] = None
    return values


def _headings(yaw: Array) -> Array:
    """Yaws as `messages.heading` makes them."""
    found, beyond = yaw.copy(), np.isfinite(yaw) & (np.abs(yaw) > math.pi)
    found[beyond] = [math.remainder(each, math.tau) for each in yaw[beyond].tolist()]
    return found
