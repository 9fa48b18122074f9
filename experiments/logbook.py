"""What a virtual run logged, as traces and as recordings: the same that a real run leaves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from agents import plugins, wire
from agents.graph import Links
from agents.hazards import Incident, Outcome
from agents.lifecycle import Phase
from agents.rows import Array, Index, Mask
from experiments import assign, goals
from experiments.channel import EPOCH
from experiments.contacts import ROUNDING_S, WALL, finds_contacts, looked_for, within
from experiments.experiment import Experiment
from experiments.goals import Goals
from experiments.recording import Recording
from experiments.trace import HeardPoses, Sent, Trace
from experiments.virtual import Log


class Logbook:
    """One repetition of a virtual run."""

    def __init__(self, log: Log, experiment: Experiment, case: str, copy: int = 0) -> None:
        """The repetition of `log.seeds[copy]`."""
        rows = len(log.names)
        self._log, self._experiment, self._case = log, experiment, case
        self._mine = slice(copy * rows, (copy + 1) * rows)
        self._seed = log.seeds[copy]
        self._scene = assign.scene(experiment)
        self._links: Links = assign.heard_links(experiment)
        time, row, seq, position, velocity, yaw = log.sent
        own = (row >= copy * rows) & (row < (copy + 1) * rows)
        self._sent = (time[own], row[own] - copy * rows, seq[own], position[own], velocity[own], yaw[own])
        per_copy = len(self._links)
        time, link, seq, stamp, position, velocity = log.heard
        own = (link >= copy * per_copy) & (link < (copy + 1) * per_copy)
        self._heard = (time[own], link[own] - copy * per_copy, seq[own], stamp[own], position[own], velocity[own])
        self._dropped: Index = log.lost[copy * per_copy : (copy + 1) * per_copy]
        self._goals: Goals | None = None
        if log.steered is not None:
            encoding = experiment.network.encoding
            self._goals = goals.of_log(log.steered, log.names, copy * rows, experiment.duration_s, encoding)

    def trace(self) -> Trace:
        """The run from the common start on, as arrays."""
        log, mine, duration = self._log, self._mine, self._experiment.duration_s
        run = (log.time >= -ROUNDING_S) & (log.time <= duration + ROUNDING_S)
        sent = self._within(self._sent[0])
        time, row, seq, position, velocity, yaw = self._sent
        sizes = np.array([len(wire.encode(pose, self._encoding)) for pose in self._poses(sent)], dtype=np.intp)
        got = self._within(self._heard[0])
        heard_time, link, heard_seq, stamp, heard_position, heard_velocity = self._heard
        link = link[got]
        rows = len(log.names)
        contacts, world = within(self._contacts(), EPOCH, duration), within(self._world(), EPOCH, duration)
        return Trace(
            case=self._case,
            experiment=self._experiment,
            seed=self._seed,
            robots=log.names,
            clock="virtual",
            time=np.round(log.time[run], 9),
            position=log.position[run, mine],
            yaw=log.yaw[run, mine],
            true_position=log.true_position[run, mine],
            goal=log.goal[run, mine],
            setpoint=log.setpoint[run, mine],
            sent=Sent(time[sent], row[sent], seq[sent], position[sent], velocity[sent], yaw[sent], sizes),
            heard=HeardPoses(
                heard_time[got],
                self._links.listener[link],
                self._links.speaker[link],
                heard_seq[got],
                stamp[got],
                heard_position[got],
                heard_velocity[got],
            ),
            lost=np.zeros(rows, dtype=np.intp),
            missed_deadlines=np.zeros(rows, dtype=np.intp),
            ticks=np.full(rows, log.ticks, dtype=np.intp),
            decisions=log.updates[mine],
            events=tuple(
                wire.Event(t, kind, source, text) for t, kind, source, text in self._events() if t <= duration
            ),
            interventions=log.interventions[mine],
            avoided=log.avoided[mine],
            contacts=contacts if looked_for(contacts, world) else None,
            world=world,
            attitude=_part(log.attitude, run, mine),
            shadow_position=_part(log.shadow_position, run, mine),
            shadow_yaw=_part(log.shadow_yaw, run, mine),
            dropped=self._dropped,
            goals=self._goals,
        )

    def record(self, path: Path, document: str) -> None:
        """Writes a recording of the whole run, take-off and landing included.

        Args:
            path: A file that does not exist yet.
            document: The experiment file, as it was written.

        Raises:
            RecordingError: If it cannot be written.
        """
        with Recording(
            path,
            self._experiment,
            document,
            case=self._case,
            seed=self._seed,
            clock="virtual",
            started=EPOCH,
        ) as recording:
            for t, kind, source, text in self._events():
                recording.event(wire.Event(EPOCH + t, kind, source, text))
            every = np.ones(len(self._sent[0]), dtype=bool)
            said = zip(self._sent[0].tolist(), self._poses(every), strict=True)
            pending = next(said, None)
            for t, states in self._states():
                while pending is not None and pending[0] <= t + ROUNDING_S:
                    size = len(wire.encode(pending[1], self._encoding))
                    recording.pose(pending[1], pending[1].stamp, size)
                    pending = next(said, None)
                for state in states:
                    recording.state(state)
            for t, goal in self._told():
                recording.goal(goal, EPOCH + t, len(wire.encode(goal, self._encoding)))
            if self._log.steered is not None:
                steered, end = self._log.steered, self._experiment.duration_s
                recording.centre(goals.report(steered, self._log.names, self._mine.start, end))
            for status in self._statuses():
                recording.status(status)
            for report in self._world():
                recording.world(report)
            for contact in self._contacts():
                recording.contact(contact)

    @property
    def _encoding(self) -> wire.Encoding:
        return self._experiment.network.encoding

    def _within(self, time: Array) -> Mask:
        """The end belongs to the landing: 50 Hz for 45 s are 2250 messages."""
        return (time >= -ROUNDING_S) & (time < self._experiment.duration_s - ROUNDING_S)

    def _poses(self, which: Mask) -> Iterator[wire.Pose]:
        names = self._log.names
        columns = (column[which].tolist() for column in self._sent)
        for t, row, seq, position, velocity, yaw in zip(*columns, strict=True):
            yield wire.pose(names[row], seq, EPOCH + t, position, velocity, yaw)

    def _told(self) -> Iterator[tuple[float, wire.Goal]]:
        """What the centre told robots, and when."""
        if self._log.steered is not None:
            yield from goals.messages(self._log.steered, self._log.names, self._mine.start)

    def _states(self) -> Iterator[tuple[float, list[wire.State]]]:
        """Telemetry, sample by sample, with the poses that each robot heard since the sample before."""
        log, mine = self._log, self._mine
        words = [phase.word for phase in Phase]
        columns = (log.phase, log.position, log.velocity, log.yaw, log.goal, log.setpoint, log.error)
        rest = (log.attitude, log.shadow_position, log.shadow_yaw)
        samples = zip(
            log.time.tolist(),
            *(column[:, mine].tolist() for column in (*columns, log.true_position, log.true_yaw)),
            *(repeat(None, len(log.time)) if column is None else column[:, mine].tolist() for column in rest),
            strict=True,
        )
        heard = self._heard_by_sample()
        followed: dict[tuple[int, int], list[wire.Followed]] = {}
        if log.steered is not None:
            followed = goals.followed(log.steered, log.time, mine.start, len(log.names))
        for k, (t, phase, position, velocity, yaw, goal, setpoint, error, truth, true_yaw, *more) in enumerate(samples):
            yield (
                t,
                [
                    wire.State(
                        name,
                        k + 1,
                        EPOCH + t,
                        words[phase[row]],
                        wire.vector(position[row]),
                        wire.vector(velocity[row]),
                        wire.heading(yaw[row]),
                        wire.vector(goal[row]),
                        None if setpoint[row][0] != setpoint[row][0] else tuple(setpoint[row]),
                        error[row],
                        wire.vector(truth[row]),
                        wire.heading(true_yaw[row]),
                        heard.get((k, row), []),
                        *_three(more, row),
                        followed.get((k, row), []),
                    )
                    for row, name in enumerate(log.names)
                ],
            )

    def _heard_by_sample(self) -> dict[tuple[int, int], list[wire.Heard]]:
        time, link, seq, stamp, position, velocity = self._heard
        names = self._log.names
        sample = np.searchsorted(self._log.time, time - ROUNDING_S)
        listener, speaker = self._links.listener[link], self._links.speaker[link]
        found: dict[tuple[int, int], list[wire.Heard]] = {}
        columns = (sample, listener, speaker, seq, stamp, time, position, velocity)
        for k, row, whose, number, taken, arrived, where, moves in zip(*(c.tolist() for c in columns), strict=True):
            news = wire.Heard(names[whose], number, EPOCH + taken, EPOCH + arrived, tuple(where), tuple(moves))
            found.setdefault((k, row), []).append(news)
        return found

    def _statuses(self) -> Iterator[wire.Status]:
        """The counters at the end of the run and at the end of everything."""
        log = self._log
        sent = self._counts(self._sent[1], self._sent[0])
        heard = self._counts(self._links.listener[self._heard[1]], self._heard[0])
        unsafe = {each.row - self._mine.start: each.text for each in self._incidents() if each.outcome >= Outcome.LAND}
        for end, phase, done in ((self._experiment.duration_s, "landing", 0), (log.ended, "done", 1)):
            for row, name in enumerate(log.names):
                mine = self._links.listener == row
                each = zip(self._links.speaker[mine].tolist(), self._dropped[mine].tolist(), strict=True)
                yield wire.Status(
                    robot=name,
                    stamp=EPOCH + end,
                    phase=phase,
                    reason=unsafe.get(row, "finished"),
                    body="",
                    battery=None,
                    sent=int(sent[done][row]),
                    heard=int(heard[done][row]),
                    lost={log.names[s]: 0 for s in self._links.speaker[mine].tolist()},
                    dropped={log.names[s]: n for s, n in each if n},
                    malformed=0,
                    refused=0,
                    ticks=log.ticks,
                    missed=0,
                    decisions=int(log.updates[self._mine][row]),
                    interventions=int(log.interventions[self._mine][row]),
                    avoided=int(log.avoided[self._mine][row]),
                    late_s=0.0,
                    started=EPOCH,
                    missing=[],
                    pid=0,
                    cpu_s=0.0,
                    rss_mb=0.0,
                )

    def _contacts(self) -> Iterator[wire.Contact]:
        """What touched in this repetition, take-off and landing included."""
        rows, names = len(self._log.names), self._log.names
        first = self._mine.start
        for touch in self._log.touches:
            if first <= touch.first < first + rows:
                other = names[touch.second - first] if touch.second >= 0 else self._obstacle(-1 - touch.second)
                yield wire.Contact(
                    EPOCH + touch.time, names[touch.first - first], other, float(touch.impulse), float(touch.overlap)
                )

    def _obstacle(self, k: int) -> str:
        return self._scene.names[k] if k < len(self._scene.names) else WALL

    def _world(self) -> Iterator[wire.WorldState]:
        """What a world would say of itself at 1 Hz; nothing where robots are alone in an empty place."""
        log, chosen, scene = self._log, self._experiment.world.engine, self._scene
        if not (scene.names or log.touches or finds_contacts(chosen)):
            return
        touched = np.sort([contact.stamp - EPOCH for contact in self._contacts()])
        moved = log.obstacles[:, self._mine.start // len(log.names)]
        whole = np.flatnonzero(np.abs(log.time - np.round(log.time)) < 0.5 / self._experiment.rates.state_hz - 1e-9)
        for k in whole.tolist():
            t = float(log.time[k])
            yield wire.WorldState(
                stamp=EPOCH + t,
                engine=plugins.split(chosen)[0],
                time=t - float(log.time[0]),
                factor=1.0,
                load=0.0,
                paused=False,
                robots=list(log.names),
                mirrored=[],
                obstacles=[
                    wire.Standing(*each) for each in zip(scene.names, map(tuple, moved[k].tolist()), strict=True)
                ],
                contacts=int(np.searchsorted(touched, t, side="right")),
                refused=0,
                malformed=0,
            )

    def _counts(self, row: Index, time: Array) -> tuple[Index, Index]:
        """How often each row occurs until the end of the run, and until the end of everything."""
        rows = len(self._log.names)
        within = time <= self._experiment.duration_s + ROUNDING_S
        return np.bincount(row[within], minlength=rows), np.bincount(row, minlength=rows)

    def _events(self) -> Iterator[tuple[float, str, str, str]]:
        """What the conductor says, and what went wrong, in order of time."""
        yield from sorted([*self._conducted(), *self._hazards()], key=lambda event: event[0])

    def _hazards(self) -> Iterator[tuple[float, str, str, str]]:
        for each in self._incidents():
            yield each.time, "hazard", self._log.names[each.row - self._mine.start], each.text

    def _incidents(self) -> Iterator[Incident]:
        """What was wrong with the robots of this repetition."""
        return (each for each in self._log.incidents if self._mine.start <= each.row < self._mine.stop)

    def _conducted(self) -> Iterator[tuple[float, str, str, str]]:
        yield self._log.airborne, "phase", "conductor", "airborne"
        yield 0.0, "start", "conductor", "common start"
        yield 0.0, "phase", "conductor", "formation"
        for leg in sorted(self._experiment.timeline, key=lambda leg: leg.at_s):
            yield leg.at_s, "phase", "conductor", f"{leg.robot} under way"
        yield self._experiment.duration_s, "phase", "conductor", "landing"


def _part(column: Array | None, run: Mask, mine: slice) -> Array | None:
    return None if column is None else column[run, mine]


def _known(value: Any) -> Any:  # noqa: ANN401 - a number or a list of them
    """For the wire: as a tuple; None if it is NaN."""
    if isinstance(value, list):
        return None if math.isnan(value[0]) else tuple(value)
    return None if math.isnan(value) else value


def _three(columns: Sequence[Any], row: int) -> tuple[Any, Any, Any]:
    """Of a row: attitude, and where its shadow is and looks; None where it has none."""
    attitude, position, yaw = (None if column is None else _known(column[row]) for column in columns)
    return attitude, position, yaw
