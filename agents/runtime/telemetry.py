"""Telemetry of a robot process for people and recorders: states, range readings, statuses.

No robot needs these; the poses for the neighbours are sent by the loop.
"""

from __future__ import annotations

import os
import resource
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import inf, isfinite
from typing import Any, Final

import msgspec
import numpy as np
import zenoh

from agents.agent import Actions, Agent
from agents.arrays import Array, Index
from agents.body.interface import BodyState
from agents.decision.lifecycle import Phase
from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.runtime import range_inbox
from agents.runtime.pose_inbox import PoseInbox

STATUS_S: Final = 1.0
INCIDENTS: Final = 16  # repeated in each status
WORDS: Final = tuple(phase.word for phase in Phase)
UNDER_WAY: Final = ("airborne", "running")


class Counts:
    """Counters of a process of n rows; ticks and interventions since the common start."""

    def __init__(self, rows: int) -> None:
        self.sent = [0] * rows  # (n) poses
        self.interventions: Index = np.zeros(rows, dtype=np.intp)  # (n,) ticks on which safety changed the decision
        self.avoided: Index = np.zeros(rows, dtype=np.intp)  # (n,) ticks on which avoidance did
        self.refused = self.ticks = self.missed = 0  # orders, ticks, skipped ticks
        self.late_s = 0.0  # [s] largest lateness of a tick since the last status

    def begin(self) -> None:
        """Resets the counters that begin at the common start."""
        self.ticks = self.missed = 0
        self.interventions[:] = self.avoided[:] = 0


class Telemetry:
    """States, statuses and range readings of the rows of a process."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        encoding: messages.Encoding,
        *,
        agent: Agent,
        neighbours: PoseInbox,  # poses received since the last state are sent with it, and removed
        counts: Counts,  # kept by the runtime
        malformed: Callable[[], int],  # number of refused payloads, other than poses
        ranged: Sequence[bool],  # (n) rows whose bodies measure ranges: those of the others come from the network
        # goals received by each row since the last state, removed here; None: no row is guided
        receipts: Sequence[deque[messages.GoalReceipt]] | None = None,
    ) -> None:
        self._agent, self._neighbours, self._counts, self._malformed = agent, neighbours, counts, malformed
        self._encoding = encoding
        names = self._names = agent.assignment.names
        mime = messages.MIME[encoding]
        self._states = [pubsub.publisher(session, keys.state(name), mime) for name in names]
        self._statuses = [pubsub.pose_publisher(session, keys.status(name), mime) for name in names]
        self._ranges = [
            pubsub.publisher(session, keys.ranges(name), mime) if own else None
            for name, own in zip(names, ranged, strict=True)
        ]
        # [s] UTC at which the clock of the process was 0, and on that clock, of the next statuses of all rows
        self.utc = self.due = 0.0
        self._receipts = [deque[messages.GoalReceipt]() for _ in names] if receipts is None else receipts
        self._seq = 0
        self._scanned = [-inf] * len(names)
        self._origin: list[messages.Setpoint | None] = [None] * len(names)
        self._last: list[messages.Status | None] = [None] * len(names)
        self._reported: list[tuple[object, ...]] = [()] * len(names)
        self._incidents: list[deque[messages.Incident]] = [deque(maxlen=INCIDENTS) for _ in names]
        self._numbers = [0] * len(names)

    def send_states(self, state: BodyState, actions: Actions, t: float) -> None:
        """Sends the state of every row, also of one whose position is unknown."""
        self._seq += 1
        agent = self._agent
        position, velocity, truth = state.position.tolist(), state.velocity.tolist(), state.true_position.tolist()
        goal, setpoint, error = agent.goal.tolist(), actions.setpoint.tolist(), agent.error.tolist()
        yaw, true_yaw, phase = state.yaw.tolist(), state.true_yaw.tolist(), agent.lifecycle.phase.tolist()
        for row, name in enumerate(self._names):
            message = messages.State(
                name,
                self._seq,
                self.utc + t,
                WORDS[phase[row]],
                messages.vector(position[row]),
                messages.vector(velocity[row]),
                messages.heading(yaw[row]),
                messages.vector(goal[row]),
                tuple(setpoint[row]) if all(map(isfinite, setpoint[row])) else None,
                messages.number(error[row]),
                messages.vector(truth[row]),
                messages.heading(true_yaw[row]),
                list(self._neighbours.news[row]),
                _known_row(state.attitude, row),
                _known_row(state.shadow_position, row),
                _known_row(state.shadow_yaw, row),
                list(self._receipts[row]),
            )
            for payload in messages.payloads(message, self._encoding):
                self._states[row].put(payload)
            self._neighbours.news[row].clear()
            self._receipts[row].clear()

    def send_ranges(self, state: BodyState) -> None:
        """Sends new range readings of the rows that measure them."""
        if state.rays is None:
            return
        for row in np.unique(state.rays.row).tolist():
            publisher = self._ranges[row]
            scan = state.rays.scan_of(row) if publisher is not None else None
            if publisher is not None and scan is not None and scan.time > self._scanned[row]:
                self._scanned[row] = scan.time
                ranges = range_inbox.message(self._names[row], self.utc, scan)
                publisher.put(messages.encode(ranges, self._encoding))

    def send_statuses(
        self, t: float, *, everything: bool, state: BodyState | None = None, changed: bool = False
    ) -> None:
        """Sends statuses: of all rows if `everything`, else of those that have changed.

        `changed`: neighbours appeared or vanished, which the phases do not show.
        """
        agent, counts = self._agent, self._counts
        if not (everything or changed or agent.lifecycle.moved or agent.hazards.incidents):
            return
        self._note_incidents()
        if everything:
            self.due = t + STATUS_S
        life = agent.lifecycle
        receiver = agent.assignment.links.receiver
        for row, name in enumerate(self._names):
            missing = agent.missing_neighbours(row)
            news = (life.phase[row], life.reason[row], tuple(missing), self._numbers[row])
            if not everything and news == self._reported[row]:
                continue
            if news[:2] != self._reported[row][:2]:
                print(f"{name}: {Phase(life.phase[row]).word}" + (f" ({news[1]})" if news[1] else ""), flush=True)
            self._reported[row] = news
            mine = [sender for sender in self._neighbours.senders if (receiver[sender.links] == row).any()]
            battery = float(state.battery[row]) if state is not None else float("nan")
            if self._origin[row] is None and state is not None and life.phase[row] == Phase.RUNNING:
                x, y, z = state.position[row].tolist()
                self._origin[row] = (x, y, z, float(state.yaw[row])) if isfinite(x + y + z) else None
            start = float(life.start_at[row])  # a plain float: msgspec does not encode those of numpy
            status = messages.Status(
                robot=name,
                stamp=self.utc + t,
                phase=Phase(life.phase[row]).word,
                reason=life.reason[row],
                body=state.notes[row] if state is not None and state.notes else "",
                battery=battery if isfinite(battery) else None,
                sent=counts.sent[row],
                received=self._neighbours.received[row],
                lost={sender.name: sender.lost for sender in mine},
                dropped=self._dropped_of(row),
                stale={sender.name: sender.stale for sender in mine if sender.stale},
                foreign={sender.name: sender.foreign for sender in mine if sender.foreign},
                malformed=self._malformed() + self._neighbours.malformed,
                refused=counts.refused,
                ticks=counts.ticks,
                missed=counts.missed,
                decisions=int(agent.updates[row]),
                interventions=int(counts.interventions[row]),
                avoided=int(counts.avoided[row]),
                late_s=counts.late_s,
                started=self.utc + start if isfinite(start) else 0.0,
                missing=missing,
                pid=os.getpid(),
                cpu_s=time.process_time(),
                rss_mb=resident_mb(),
                origin=agent.origin(row) or self._origin[row],
                hazard=agent.hazards.worst(row),
                incidents=list(self._incidents[row]),
            )
            self._last[row] = status
            self._statuses[row].put(messages.encode(status, self._encoding))
        if everything:
            counts.late_s = 0.0

    def _note_incidents(self) -> None:
        """Moves incidents from the decision into statuses, and prints them: the log outlives the network."""
        happened = self._agent.hazards.incidents
        for incident in happened:
            row = incident.row
            self._numbers[row] += 1
            self._incidents[row].append(
                messages.Incident(self._numbers[row], round(self.utc + incident.time, 6), incident.text)
            )
            print(f"{self._names[row]}: {incident.text}", flush=True)
        happened.clear()

    def repeat_statuses(self, reason: str, stamp: float) -> None:
        """Repeats the last statuses with another `reason`; from any thread, while the loop hangs."""
        for publisher, status in zip(self._statuses, self._last, strict=True):
            if status is not None:
                phase = "landing" if status.phase in UNDER_WAY else status.phase
                repeated = msgspec.structs.replace(status, stamp=stamp, phase=phase, reason=reason)
                publisher.put(messages.encode(repeated, self._encoding))

    def _dropped_of(self, row: int) -> dict[str, int]:
        assignment = self._agent.assignment
        dropped = self._neighbours.dropped
        at = np.flatnonzero((dropped > 0) & (assignment.links.receiver == row))
        senders = assignment.links.sender[at].tolist()
        return {assignment.robots[j]: int(n) for j, n in zip(senders, dropped[at].tolist(), strict=True)}


def _known_row(column: Array | None, row: int) -> Any:  # noqa: ANN401 - a number or a tuple, as the column has it
    """A row of an optional column of the body's state, for a message; None if unknown."""
    if column is None or not np.isfinite(column[row]).all():
        return None
    value = column[row].tolist()
    return tuple(value) if isinstance(value, list) else value


def resident_mb() -> float:
    """Memory of this process [MB]."""
    try:
        with open("/proc/self/statm", "rb") as pages:  # noqa: PTH123 - a Path costs more than the read
            return int(pages.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
