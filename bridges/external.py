"""Body in another process, a simulator or a robot: commands go out on one key, positions come in on another.

The contract is `docs/external-simulators.md`; it requires nothing that a simulator could not know.
"""

from __future__ import annotations

import threading
import time
from math import isfinite
from typing import Final, Literal

import msgspec
import numpy as np
import zenoh

from agents.arrays import Array, Index, Mask, norm, some
from agents.body.external_pose import External
from agents.body.interface import UNANSWERED, BodyError, BodyRequest, BodyState
from agents.body.measured_positions import MeasuredPositions
from agents.clock import uptime
from agents.errors import ExplainedError
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.shutdown import leave
from agents.runtime.range_inbox import RangeInbox
from bridges.measured_flight import FRESH_S, SETTLED, MeasuredFlight

Action = Literal["drive", "takeoff", "land", "stop"]

OPEN_S: Final = 5.0  # deadline of the router's answer and of the first position of every row
POLL_S: Final = 0.02  # between looks for them
WORLD: Final = "world"  # the address of robots in the shared world process
REPEAT_S: Final = 0.1  # period of repeated orders: the publisher drops samples when its queue is full
HALT_S: Final = 3.0  # how long `land` is repeated to a robot on wheels
ANSWER_S: Final = 2.5  # the note reports a robot that is not measured to stand so long after a stop
SUPERSEDED_S: Final = 1.0  # a shorter standstill costs no process its name
STANDSTILL_S: Final = 1.0  # how long `close` waits until stopped robots are measured to stand
REACH: Final = (1e3, 1e3, 1e3)  # [m] bounds of valid positions: any room


class _RepeatedOrder(msgspec.Struct):
    """An order repeated under its own sequence number until it is completed or `until`.

    Until completed, not begun: the simulator may be restarted half-way through a climb or a landing, and then knows no
    earlier order.
    """

    order: messages.Command
    until: float  # [s]


class ExternalBody:
    """Robots of another process; implements `agents.body.interface.Body`.

    Its own clock is `uptime` and starts at creation; `read` measures the offset of the caller's clock.
    """

    def __init__(self, request: BodyRequest) -> None:
        """Create the body, still closed; raises BodyError if a row has settings: there are none."""
        for name, device in zip(request.names, request.device, strict=True):
            if device:
                raise BodyError(f"{name}: device: `{next(iter(device))}` is unknown; an external body has no settings")
        rows = len(request.names)
        self._names, self._keys = request.names, request.keys
        self._endpoints, self._addresses = request.endpoints, request.addresses
        self._flies = np.array([kind.flies for kind in request.kinds])
        self._steers = np.array([kind.takes == "twist" for kind in request.kinds])
        self._zero = uptime()
        self._clock, self._corrected = request.clock, request.clock.correction_s
        self._utc = request.clock.utc()  # one reading, as in the runtime: a step of the wall clock has no effect
        self._clock_offset = np.inf  # from the caller's clock to this one [s]
        self._poses = External(rows)
        self._yaw = np.array(request.yaw, dtype=float)  # last measured
        self._yaw_at = np.full(rows, -np.inf)
        self._flight = MeasuredFlight(rows)
        self._stopped = np.zeros(rows, dtype=bool)
        self._stopped_since = np.full(rows, np.inf)
        # sequence numbers grow over restarts: a simulator that outlives this process can tell new orders from old
        self._seq = [round(1e3 * self._utc)] * rows
        self._read_at = np.inf  # last call of `read`
        self._repeated: dict[int, _RepeatedOrder] = {}
        self._next_repeat = 0.0
        self._lock = threading.Lock()  # of the sequence numbers: `land` and `stop` are called from other threads too
        self._session: zenoh.Session | None = None

    # ------------------------------------------------------------------ Body

    def open(self) -> None:
        deadline = time.monotonic() + OPEN_S
        try:
            name = f"body of {'+'.join(self._names)}"
            self._session = network.open_session(self._endpoints, name=name, wait_s=OPEN_S, identity=self._names[0])
        except ExplainedError as error:
            raise BodyError(f"{', '.join(self._names)}: {error}") from None
        session, keys, mime = self._session, self._keys, messages.MIME["json"]
        rows = range(len(self._names))
        self._positions = MeasuredPositions(session, keys, self._names, rows, REACH, exact=rows, silence_s=FRESH_S)
        self._ranges = RangeInbox(session, keys, self._names, rows)
        self._setpoints = [pubsub.publisher(session, keys.setpoint(name), mime) for name in self._names]
        self._orders = [
            pubsub.publisher(session, keys.setpoint(name), mime, zenoh.Priority.REAL_TIME) for name in self._names
        ]
        pause = threading.Event()
        while (missing := self._missing_positions()) and time.monotonic() < deadline:
            pause.wait(POLL_S)
        if missing:
            self.close()
            raise BodyError("\n".join(missing))

    def read(self, t: float) -> BodyState:
        self._outnumber_successor()
        self._clock_offset = min(self._clock_offset, self._now() - t)  # a late call only makes the difference larger
        self._read_positions()
        self._update_flying()
        rows = len(self._names)
        nothing = np.full((rows, 3), np.nan)
        rays = self._ranges.read(self._utc, self._now())
        return BodyState(
            time=self._measured() - self._clock_offset,
            position=self._poses.position.copy(),
            velocity=self._velocity(),
            yaw=self._yaw.copy(),
            true_position=nothing,
            true_yaw=nothing[:, 0],
            battery=nothing[:, 0],
            flying=self._flight.flying.copy(),
            notes=self._notes(),
            rays=None if rays is None else msgspec.structs.replace(rays, time=rays.time - self._clock_offset),
            ahead=self._positions.ahead,
        )

    def command(self, setpoint: Array) -> None:
        given = np.isfinite(setpoint).all(axis=1) & ~self._stopped
        values = setpoint.tolist()
        for row in np.flatnonzero(given).tolist():
            x, y, z, w = values[row]
            self._send_setpoint(row, (x, y, z, w))
        now = self._now()
        if self._repeated and now >= self._next_repeat:
            self._next_repeat = now + REPEAT_S
            with self._lock:
                for row, repeated in list(self._repeated.items()):
                    if now > repeated.until:
                        del self._repeated[row]
                    else:
                        self._put(row, msgspec.structs.replace(repeated.order, stamp=self._stamp()))

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`; no effect on ground robots, or after a stop."""
        for row, up in zip(rows.tolist(), height.tolist(), strict=True):
            if self._flies[row] and not self._stopped[row]:
                self._flight.take_off(row, self._poses.position[row])
                self._send_order(row, "takeoff", np.inf, up)

    def land(self, rows: Index) -> None:
        """See `Body.land`; no effect after a stop."""
        for row in rows[~self._stopped[rows]].tolist():
            self._flight.land(row, self._now())
            self._send_order(row, "land", np.inf if self._flight.flying[row] else HALT_S)

    def stop(self, rows: Index) -> None:
        """See `Body.stop`; repeated as long as this process lives."""
        for row in rows.tolist():
            if not self._stopped[row]:
                now = self._now()
                self._stopped[row], self._stopped_since[row] = True, now
                # from now on the robot counts as flying until it is measured on the ground
                self._flight.land(row, now)
                self._send_order(row, "stop", np.inf)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """No effect: this body subscribes to the key `position` itself."""

    def close(self) -> None:
        if self._session is not None:
            until, nothing = self._now() + STANDSTILL_S, np.full((len(self._names), 4), np.nan)
            while some(self._unconfirmed_stops()) and self._now() < until:
                time.sleep(POLL_S)
                self.command(nothing)
                self._read_positions()
                self._update_flying()
            leave(self._session, self)
            self._session = None

    # ------------------------------------------------------------------ positions received

    def _now(self) -> float:
        return uptime() - self._zero + self._clock.correction_s - self._corrected

    def _stamp(self) -> float:
        return round(self._utc + self._now(), 6)

    def _read_positions(self) -> None:
        for row, taken, position, yaw in self._positions.receive(self._utc, self._now()):
            if self._poses.update(row, taken, position, yaw) and isfinite(yaw):
                self._yaw[row], self._yaw_at[row] = yaw, taken

    def _measured(self) -> Array:
        """Time (n,) of the poses; a robot that steers by its yaw has no newer pose than that."""
        late = self._steers & (self._yaw_at < self._poses.time - FRESH_S)
        return np.where(late, self._yaw_at, self._poses.time)

    def _missing_positions(self) -> list[str]:
        """Diagnosis and remedy for each row without a usable position."""
        self._read_positions()
        now, found = self._now(), []
        for row, name in enumerate(self._names):
            key, age = self._keys.position(name), now - float(self._poses.time[row])
            if not isfinite(age):
                found.append(
                    f"{name}: samples on {key} are not positions: {self._positions.trouble[row]}"
                    if self._positions.malformed[row]
                    else f"{name}: nothing is published on {key}: is {self._source_name(row)} running and connected to "
                    f"{', '.join(self._endpoints)}?"
                )
            elif age > FRESH_S:
                found.append(
                    f"{name}: the position on {key} was measured {age:.1f} s ago by its stamp: stamps are UTC seconds, "
                    "not simulation time; if they are UTC, set the clocks of both computers"
                )
            elif self._steers[row] and not isfinite(self._poses.yaw[row]):
                found.append(f"{name}: the position on {key} has no yaw, without which a robot on wheels cannot steer")
        return found

    def _source_name(self, row: int) -> str:
        return "`./zenpark world serve` with this experiment" if self._addresses[row] == WORLD else "the simulator"

    def _velocity(self) -> Array:
        """Velocities (n, 3) [m/s]; a robot on wheels without positions stands some time after a halt."""
        now = self._now()
        stands = ~self._flies & (now - self._flight.landing_since > HALT_S) & (now - self._poses.time > FRESH_S)
        return np.where(stands[:, None], 0.0, self._poses.velocity)

    def _unconfirmed_stops(self) -> Mask:
        """Stopped rows that are not measured to stand."""
        return self._stopped & (self._flight.flying | (norm(self._velocity()) > SETTLED))

    def _update_flying(self) -> None:
        """Update which rows fly; orders to rows that are down are complete."""
        climbing = np.isin(np.arange(len(self._names)), list(self._repeated))
        down = self._flight.update(self._now(), self._poses.time, self._poses.position, self._poses.velocity, climbing)
        with self._lock:
            for row in np.flatnonzero(down).tolist():
                if not self._stopped[row]:
                    self._repeated.pop(row, None)

    def _notes(self) -> tuple[str, ...]:
        age, positions = self._now() - self._measured(), self._positions
        unanswered = self._unconfirmed_stops() & (self._now() - self._stopped_since > ANSWER_S)
        if not ((age > FRESH_S) | unanswered).any() and not any(positions.malformed) and not self._ranges.malformed:
            return ()
        notes = []
        for row, seconds in enumerate(age.tolist()):
            parts = [UNANSWERED] if unanswered[row] else []
            what = "yaw" if self._measured()[row] < self._poses.time[row] else "position"
            parts += [f"no {what} for {seconds:.0f} s"] if seconds > FRESH_S else []
            if positions.malformed[row]:
                parts.append(f"{positions.malformed[row]} positions refused, the last because {positions.trouble[row]}")
            if self._ranges.malformed:
                parts.append(f"{self._ranges.malformed} sweeps refused, the last because {self._ranges.trouble}")
            notes.append("; ".join(parts))
        return tuple(notes)

    # ------------------------------------------------------------------ commands sent

    def _send_setpoint(self, row: int, setpoint: messages.Setpoint) -> None:
        with self._lock:
            if self._stopped[row]:
                return  # stopped while the setpoint was computed
            self._put(row, self._next_command(row, "drive", setpoint))
            if (repeated := self._repeated.get(row)) is not None and repeated.order.action == "takeoff":
                del self._repeated[row]  # setpoints replace a take-off

    def _send_order(self, row: int, action: Action, seconds: float, height: float | None = None) -> None:
        """Send an order now, and repeat it for `seconds`."""
        with self._lock:
            if action == "takeoff" and self._stopped[row]:
                return  # stopped meanwhile, by another thread
            order = self._next_command(row, action, height=height)
            self._repeated[row] = _RepeatedOrder(order, self._now() + seconds)
            self._put(row, order)

    def _outnumber_successor(self) -> None:
        """After a standstill, go on with numbers beyond those of a process that had the name meanwhile."""
        before, self._read_at = self._read_at, self._now()
        if self._read_at - before > SUPERSEDED_S:
            least = round(1e3 * (self._utc + self._read_at))
            with self._lock:
                self._seq = [max(seq, least) for seq in self._seq]

    def _next_command(
        self, row: int, action: Action, setpoint: messages.Setpoint | None = None, height: float | None = None
    ) -> messages.Command:
        self._seq[row] += 1
        return messages.Command(self._names[row], self._seq[row], self._stamp(), action, setpoint, height)

    def _put(self, row: int, command: messages.Command) -> None:
        if self._session is None:
            return  # `stop` may be called after `close`
        try:
            publishers = self._setpoints if command.action == "drive" else self._orders
            publishers[row].put(messages.encode(command))
        except zenoh.ZError as error:
            self._positions.trouble[row] = f"commands cannot be sent: {error}"
