"""Telemetry of a robot process for people and recorders: states, range readings, statuses.

No robot needs these; the poses for the neighbours are sent by the loop.
"""

from __future__ import annotations

import os
import resource
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Final

import msgspec
import zenoh

from agents.body.interface import UNANSWERED, BodyState
from agents.decision.lifecycle import UNDER_WAY, Phase, Standing
from agents.decision.stepping import Stepping
from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime import range_inbox
from agents.runtime.pose_inbox import PoseInbox
from agents.ticks import ROUNDING_S

STATUS_S: Final = 1.0
INCIDENTS: Final = 16  # repeated in each status
WORDS: Final = tuple(phase.word for phase in Phase)


@dataclass(eq=False)
class Counts:
    """Counters of a process of n robots; ticks and interventions since the common start."""

    sent: list[int]  # (n) poses
    refused: int = 0  # orders
    ticks: int = 0
    missed: int = 0  # skipped ticks
    late_s: float = 0.0  # [s] largest lateness of a tick since the last status

    def begin(self) -> None:
        """Resets the counters that begin at the common start."""
        self.ticks = self.missed = 0


class TelemetryPublisher:
    """States, statuses and range readings of the robots of a process."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        encoding: messages.Encoding,
        *,
        robots: Sequence[Robot],
        neighbours: PoseInbox,  # poses received since the last state are sent with it, and removed
        counts: Counts,  # kept by the runtime
        malformed: Callable[[], int],  # number of refused payloads, other than poses
        ranged: Sequence[bool],  # (n) robots with bodies that measure ranges: those of the others come from the network
        # goals received by each robot since the last state, removed here; None: no robot is guided
        receipts: Sequence[deque[messages.GoalReceipt]] | None = None,
    ) -> None:
        self._robots, self._neighbours, self._counts, self._malformed = robots, neighbours, counts, malformed
        self._encoding = encoding
        names = self._names = tuple(robot.assignment.name for robot in robots)
        mime = messages.MIME[encoding]
        self._memories = [
            None if robot.stepping is None else pubsub.publisher(session, keys.memory(robot.assignment.name), mime)
            for robot in robots
        ]
        self._states = [pubsub.publisher(session, keys.state(name), mime) for name in names]
        self._statuses = [pubsub.pose_publisher(session, keys.status(name), mime) for name in names]
        self._ranges = [
            pubsub.publisher(session, keys.ranges(name), mime) if own else None
            for name, own in zip(names, ranged, strict=True)
        ]
        # [s] UTC at which the clock of the process was 0, and on that clock, of the next statuses of all robots
        self.utc = self.due = 0.0
        self._receipts = [deque[messages.GoalReceipt]() for _ in names] if receipts is None else receipts
        self._seq = 0
        self._scanned = [-inf] * len(names)
        # memories sent last, and when [s]
        self._sent_memories: list[tuple[object, float]] = [(None, -inf)] * len(names)
        self._origin: list[messages.Setpoint | None] = [None] * len(names)
        self._last: list[messages.Status | None] = [None] * len(names)
        self._reported: list[tuple[object, ...]] = [()] * len(names)
        self._incidents: list[deque[messages.Incident]] = [deque(maxlen=INCIDENTS) for _ in names]
        self._numbers = [0] * len(names)
        self._ended = [0.0] * len(names)  # [s] UTC at which each began to land; 0 before
        # whether wheels stand after the end; None once the body has confirmed that, or that its motors are off
        self._resting: list[Standing | None] = [Standing() for _ in names]

    def send_states(self, t: float) -> None:
        """Sends the state of every robot, also of one without a known position."""
        self._seq += 1
        for row, robot in enumerate(self._robots):
            now, state = robot.now, robot.now.state
            setpoint = robot.setpoint
            attitude, shadow = state.attitude, state.shadow_position
            message = messages.State(
                self._names[row],
                self._seq,
                self.utc + t,
                WORDS[self._phase(row)],
                messages.vector(now.position),
                messages.vector(now.velocity),
                messages.heading(now.yaw),
                messages.vector(robot.goal),
                setpoint if all(map(isfinite, setpoint)) else None,
                messages.number(robot.error),
                messages.vector(state.true_position),
                messages.heading(state.true_yaw),
                list(self._neighbours.unreported[row]),
                attitude if all(map(isfinite, attitude)) else None,
                messages.vector(shadow),
                messages.number(state.shadow_yaw),
                list(self._receipts[row]),
            )
            for payload in messages.payloads(message, self._encoding):
                self._states[row].put(payload)
            if robot.stepping is not None:
                self._send_memory(row, robot.stepping, t)
            self._neighbours.unreported[row].clear()
            self._receipts[row].clear()

    def _send_memory(self, row: int, stepping: Stepping, t: float) -> None:
        """Send what the law remembers as soon as it has stepped, and else once in the time of a step."""
        publisher, (last, sent_at) = self._memories[row], self._sent_memories[row]
        if publisher is None or (stepping.memory is last and t - sent_at < stepping.facts.step_s - ROUNDING_S):
            return
        self._sent_memories[row] = stepping.memory, t
        memory = messages.memory(self._names[row], self._seq, self.utc + t, stepping.memory, stepping.measures)
        publisher.put(messages.encode(memory, self._encoding))

    def send_ranges(self, states: Sequence[BodyState]) -> None:
        """Sends new range readings of the robots that measure them."""
        for row, state in enumerate(states):
            publisher, scan = self._ranges[row], state.scan
            if publisher is not None and scan is not None and scan.time > self._scanned[row]:
                self._scanned[row] = scan.time
                ranges = range_inbox.message(self._names[row], self.utc, scan)
                publisher.put(messages.encode(ranges, self._encoding))

    def send_statuses(
        self, t: float, *, everything: bool, states: Sequence[BodyState] = (), changed: bool = False
    ) -> None:
        """Sends statuses: of all robots if `everything`, else of those that have changed.

        `changed`: neighbours appeared or vanished, which the phases do not show.
        """
        counts = self._counts
        for row, robot in enumerate(self._robots):
            waited = robot.lifecycle.phase == Phase.DONE and self._resting[row] is not None
            changed = changed or robot.lifecycle.moved or waited or bool(robot.hazards.incidents)
        if not (everything or changed):
            return
        self._note_incidents()
        if everything:
            self.due = t + STATUS_S
        for row, robot in enumerate(self._robots):
            life, missing = robot.lifecycle, robot.missing_neighbours()
            phase = self._phase(row)
            self._ended[row] = (self._ended[row] or self.utc + t) if phase >= Phase.LANDING else 0.0
            news = (phase, messages.without_numbers(life.reason), tuple(missing), self._numbers[row])
            if not everything and news == self._reported[row]:
                continue
            if news[:2] != self._reported[row][:2]:
                print(
                    f"{self._names[row]}: {WORDS[phase]}" + (f" ({life.reason})" if life.reason else ""),
                    flush=True,
                )
            self._reported[row] = news
            self._last[row] = status = self._status(row, t, missing, states[row] if states else None)
            self._statuses[row].put(messages.encode(status, self._encoding))
        if everything:
            counts.late_s = 0.0

    def _status(self, row: int, t: float, missing: list[str], state: BodyState | None) -> messages.Status:
        robot, counts = self._robots[row], self._counts
        life, senders = robot.lifecycle, self._neighbours.senders_of(row)
        if self._origin[row] is None and state is not None and life.phase == Phase.RUNNING:
            x, y, z = robot.now.position
            self._origin[row] = (x, y, z, state.yaw) if isfinite(x + y + z) else None
        return messages.Status(
            robot=self._names[row],
            stamp=self.utc + t,
            phase=WORDS[self._phase(row)],
            reason=life.reason,
            body="" if state is None else state.note,
            battery=None if state is None else messages.number(state.battery),
            sent=counts.sent[row],
            received=self._neighbours.received[row],
            lost={sender.name: sender.lost for sender in senders},
            dropped=self._neighbours.dropped_of(row),
            stale={sender.name: sender.stale for sender in senders if sender.stale},
            foreign={sender.name: sender.foreign for sender in senders if sender.foreign},
            malformed=self._malformed() + self._neighbours.malformed,
            refused=counts.refused,
            ticks=counts.ticks,
            missed=counts.missed,
            decisions=robot.updates,
            interventions=robot.interventions,
            avoided=robot.evasions,
            late_s=counts.late_s,
            started=self.utc + life.start_at if isfinite(life.start_at) else 0.0,
            ended=self._ended[row],
            missing=missing,
            pid=os.getpid(),
            cpu_s=time.process_time(),
            rss_mb=resident_mb(),
            origin=robot.origin or self._origin[row],
            hazard=robot.hazards.worst(),
            incidents=list(self._incidents[row]),
        )

    def unconfirmed(self) -> bool:
        """Whether a robot is not known yet to have its motors off, or its wheels stand."""
        return any(self._phase(row) != Phase.DONE for row in range(len(self._robots)))

    def _phase(self, row: int) -> int:
        """Phase of a robot for others: one that was stopped lands until its body confirms that, then it is done."""
        robot = self._robots[row]
        phase, state = robot.lifecycle.phase, robot.now.state
        if phase != Phase.DONE:
            self._resting[row] = Standing()
        elif resting := self._resting[row]:
            now = robot.now
            rolls = not robot.assignment.kind.flies and not resting.stands(now.t, now.position, now.velocity)
            if not (state.flying or rolls or UNANSWERED in state.note):
                self._resting[row] = None
        return int(Phase.LANDING) if phase == Phase.DONE and self._resting[row] else phase

    def _note_incidents(self) -> None:
        """Moves incidents from the decision into statuses, and prints them: the log outlives the network."""
        for row, robot in enumerate(self._robots):
            for incident in robot.hazards.incidents:
                self._numbers[row] += 1
                self._incidents[row].append(
                    messages.Incident(self._numbers[row], round(self.utc + incident.time, 6), incident.text)
                )
                print(f"{self._names[row]}: {incident.text}", flush=True)
            robot.hazards.incidents.clear()

    def repeat_statuses(self, reason: str, stamp: float) -> None:
        """Repeats the last statuses with another `reason`; from any thread, while the loop hangs."""
        for publisher, status in zip(self._statuses, self._last, strict=True):
            if status is not None:
                down = status.phase in UNDER_WAY
                phase, ended = ("landing", stamp) if down else (status.phase, status.ended)
                repeated = msgspec.structs.replace(status, stamp=stamp, phase=phase, reason=reason, ended=ended)
                publisher.put(messages.encode(repeated, self._encoding))


def resident_mb() -> float:
    """Memory of this process [MB]."""
    try:
        with open("/proc/self/statm", "rb") as pages:  # noqa: PTH123 - a Path costs more than the read
            return int(pages.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
