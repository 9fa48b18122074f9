"""A body in another process: any simulator, or any robot, that hears commands and says where it is on two keys.

The contract is `docs/external-simulators.md`; nothing of it is asked about here that the far end could not know.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from math import isfinite
from typing import Final, Literal

import msgspec
import numpy as np
import zenoh

from agents.arrays import Array, Index, Mask, norm, some
from agents.body.external_pose import External
from agents.body.interface import UNANSWERED, BodyError, BodyRequest, BodyState
from agents.body.measured_positions import MeasuredPositions
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import EndpointError
from agents.network.shutdown import leave
from agents.runtime.range_inbox import HeardRanges

Action = Literal["drive", "takeoff", "land", "stop"]

OPEN_S: Final = 5.0  # for the router to answer and a first position of every row to come
LOOK_S: Final = 0.02  # between looks for it
STALE_S: Final = 0.5  # what the robots bear
WORLD: Final = "world"  # the address of robots that the twin service carries
REPEAT_S: Final = 0.1  # an order is said again this often: the publisher drops what does not fit
HALT_S: Final = 3.0  # a robot on wheels that was told to land is told so this long
LANDING_S: Final = 10.0  # a robot that was told to land this long ago, and cannot be seen, is taken for down
LAIN_S: Final = 1.0  # one that is seen on the ground for so long, though it was steered, has come down by itself
AWAY_M: Final = 0.05  # higher above the place of take-off than this it is in the air, lower it is down
SETTLED: Final = 0.1  # [m/s] slower than this it is down
ANSWER_S: Final = 2.5  # a stop after which a robot is not seen to stand for so long is worth a word
FAREWELL_S: Final = 1.0  # how long `close` waits until robots that were stopped are seen to stand
REACH: Final = (1e3, 1e3, 1e3)  # [m] any room


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `device` of a robot whose body is external: nothing to set."""


class _Standing(msgspec.Struct):
    """An order that is repeated, under the number that it had, until it is obeyed or `until` [s].

    Obeyed to the end, not begun: half-way through a climb or a landing another process may answer at the far end, as
    soon as the first one died, and it knows of no earlier order.
    """

    order: messages.Command
    until: float


class ExternalBody:
    """Rows whose robots live in another process; implements `agents.body.interface.Body`.

    Its own clock is the monotonic one, from when it was made; `read` tells how the clock of its caller lies to it.
    """

    def __init__(self, request: BodyRequest) -> None:
        """Makes it ready to be opened.

        Raises:
            BodyError: If a row has settings: there are none.
        """
        for name, device in zip(request.names, request.device, strict=True):
            try:
                msgspec.convert(dict(device), Settings)
            except msgspec.ValidationError as error:
                raise BodyError(f"{name}: device: {error}; a body that is external has no settings") from None
        rows = len(request.names)
        self._names, self._kinds, self._keys = request.names, request.kinds, request.keys
        self._endpoints, self._addresses = request.endpoints, request.addresses
        self._flies = np.array([kind.flies for kind in request.kinds])
        self._zero = time.monotonic()
        self._clock, self._corrected = request.clock, request.clock.correction_s
        self._utc = request.clock.utc()  # one reading, as in the runtime: a step of the wall clock moves nothing
        self._shift = np.inf  # from the caller's clock to this one
        self._seen = External(rows)
        self._yaw = np.array(request.yaw, dtype=float)
        self._flying = np.zeros(rows, dtype=bool)
        self._landing = np.full(rows, np.inf)  # since when
        self._ground = np.zeros(rows)
        self._lain = np.full(rows, np.inf)  # since when it is seen on the ground although it should fly
        self._stopped = np.zeros(rows, dtype=bool)
        self._stopped_at = np.full(rows, np.inf)
        # so that numbers grow over restarts: a simulator that outlives this process knows new orders from old
        self._sent = [round(1e3 * self._utc)] * rows
        self._standing: dict[int, _Standing] = {}
        self._repeat = 0.0
        self._lock = threading.Lock()  # of the numbers: `land` and `stop` come from other threads too
        self._session: zenoh.Session | None = None

    # ------------------------------------------------------------------ Body

    def open(self) -> None:
        """See `Body.open`."""
        deadline = time.monotonic() + OPEN_S
        try:
            name = f"body of {'+'.join(self._names)}"
            self._session = network.open_session(self._endpoints, name=name, wait_s=OPEN_S, identity=self._names[0])
        except (network.Unreachable, EndpointError) as error:
            raise BodyError(f"{', '.join(self._names)}: {error}") from None
        session, keys, mime = self._session, self._keys, messages.MIME["json"]
        rows = range(len(self._names))
        self._positions = MeasuredPositions(session, keys, self._names, rows, REACH)
        self._ranges = HeardRanges(session, keys, self._names, rows)
        self._setpoints = [pubsub.publisher(session, keys.setpoint(name), mime) for name in self._names]
        self._orders = [pubsub.urgent_publisher(session, keys.setpoint(name), mime) for name in self._names]
        pause = threading.Event()
        while (missing := self._missing()) and time.monotonic() < deadline:
            pause.wait(LOOK_S)
        if missing:
            self.close()
            raise BodyError("\n".join(missing))

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        self._shift = min(self._shift, self._now() - t)  # whoever calls late, sees too large a difference
        self._listen()
        self._settle()
        rows = len(self._names)
        nothing = np.full((rows, 3), np.nan)
        rays = self._ranges.read(self._utc, self._now())
        return BodyState(
            time=self._seen.time - self._shift,
            position=self._seen.position.copy(),
            velocity=self._velocity(),
            yaw=np.where(np.isfinite(self._seen.yaw), self._seen.yaw, self._yaw),
            true_position=nothing,
            true_yaw=nothing[:, 0],
            battery=nothing[:, 0],
            flying=self._flying.copy(),
            notes=self._notes(),
            rays=None if rays is None else replace(rays, time=rays.time - self._shift),
            ahead=self._positions.ahead,
        )

    def command(self, setpoint: Array) -> None:
        """See `Body.command`."""
        given = np.isfinite(setpoint).all(axis=1) & ~self._stopped
        values = setpoint.tolist()
        for row in np.flatnonzero(given).tolist():
            x, y, z, w = values[row]
            self._drive(row, (x, y, z, w))
        now = self._now()
        if self._standing and now >= self._repeat:
            self._repeat = now + REPEAT_S
            with self._lock:
                for row, standing in list(self._standing.items()):
                    if now > standing.until:
                        del self._standing[row]
                    else:
                        self._put(row, msgspec.structs.replace(standing.order, stamp=self._stamp()))

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`; ground robots have nothing to do."""
        for row, up in zip(rows.tolist(), height.tolist(), strict=True):
            if self._flies[row]:
                z = self._seen.position[row, 2]
                self._ground[row] = z if isfinite(z) else 0.0
                self._flying[row], self._landing[row], self._stopped[row] = True, np.inf, False
                self._order(row, "takeoff", np.inf, up)

    def land(self, rows: Index) -> None:
        """See `Body.land`; a stop is the last word."""
        for row in rows[~self._stopped[rows]].tolist():
            self._landing[row] = self._now()
            self._order(row, "land", LANDING_S if self._flying[row] else HALT_S)

    def stop(self, rows: Index) -> None:
        """See `Body.stop`; said again for as long as this process lives."""
        for row in rows.tolist():
            if not self._stopped[row]:
                now = self._now()
                self._stopped[row], self._stopped_at[row] = True, now
                self._landing[row] = min(self._landing[row], now)  # from now on it flies until it is seen to be down
                self._order(row, "stop", np.inf)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """Nothing: what the runtime heard on the key `position` has been heard here."""

    def close(self) -> None:
        """See `Body.close`."""
        if self._session is not None:
            until, nothing = self._now() + FAREWELL_S, np.full((len(self._names), 4), np.nan)
            while some(self._unanswered()) and self._now() < until:
                time.sleep(LOOK_S)
                self.command(nothing)
                self._listen()
                self._settle()
            leave(self._session, self)
            self._session = None

    # ------------------------------------------------------------------ what the far end says

    def _now(self) -> float:
        return time.monotonic() - self._zero + self._clock.correction_s - self._corrected

    def _stamp(self) -> float:
        return round(self._utc + self._now(), 6)

    def _listen(self) -> None:
        for row, taken, position, yaw in self._positions.receive(self._utc, self._now()):
            self._seen.update(row, taken, position, yaw)

    def _missing(self) -> list[str]:
        """What every row lacks before it can be driven, and what to do."""
        self._listen()
        now, found = self._now(), []
        for row, name in enumerate(self._names):
            key, age = self._keys.position(name), now - float(self._seen.time[row])
            if not isfinite(age):
                found.append(
                    f"{name}: what is published on {key} is no position: {self._positions.trouble[row]}"
                    if self._positions.malformed[row]
                    else f"{name}: nothing is published on {key}: is {self._far_end(row)} running and connected to "
                    f"{', '.join(self._endpoints)}?"
                )
            elif age > STALE_S:
                found.append(
                    f"{name}: the position on {key} was measured {age:.1f} s ago by its stamp: stamps are UTC seconds, "
                    "not the time of the simulation; if they are, set the clocks of both computers"
                )
            elif self._kinds[row].takes == "twist" and not isfinite(self._seen.yaw[row]):
                found.append(f"{name}: the position on {key} has no yaw, without which a robot on wheels cannot steer")
        return found

    def _far_end(self, row: int) -> str:
        return "`zenpark world` with this experiment" if self._addresses[row] == WORLD else "the simulator"

    def _velocity(self) -> Array:
        """Of all rows (n, 3) [m/s]; one on wheels that was told to halt long ago, and cannot be seen, stands."""
        now = self._now()
        stands = ~self._flies & (now - self._landing > HALT_S) & (now - self._seen.time > STALE_S)
        return np.where(stands[:, None], 0.0, self._seen.velocity)

    def _unanswered(self) -> Mask:
        """Rows that were stopped and are not seen to stand."""
        return self._stopped & (self._flying | (norm(self._velocity()) > SETTLED))

    def _settle(self) -> None:
        """Ends the landings that have come to their end, and finds those that nobody here ordered."""
        if not some(self._flying):
            return
        now = self._now()
        landing = np.isfinite(self._landing)
        high = self._seen.position[:, 2] - self._ground > AWAY_M
        slow = np.abs(self._seen.velocity[:, 2]) < SETTLED
        aged = now - self._seen.time > STALE_S
        seen = ~aged & ~high & slow
        climbing = np.isin(np.arange(len(self._names)), list(self._standing))
        self._lain = np.where(seen & self._flying & ~climbing, np.minimum(self._lain, now), np.inf)
        alone = ~landing & (now - self._lain > LAIN_S)
        down = self._flying & ((landing & np.where(aged, now - self._landing > LANDING_S, seen)) | alone)
        self._flying &= ~down
        with self._lock:
            for row in np.flatnonzero(down).tolist():
                if not self._stopped[row]:
                    self._standing.pop(row, None)

    def _notes(self) -> tuple[str, ...]:
        age, positions = self._now() - self._seen.time, self._positions
        unanswered = self._unanswered() & (self._now() - self._stopped_at > ANSWER_S)
        if not ((age > STALE_S) | unanswered).any() and not any(positions.malformed) and not self._ranges.malformed:
            return ()
        notes = []
        for row, seconds in enumerate(age.tolist()):
            parts = [UNANSWERED] if unanswered[row] else []
            parts += [f"no position for {seconds:.0f} s"] if seconds > STALE_S else []
            if positions.malformed[row]:
                parts.append(f"{positions.malformed[row]} positions refused, the last because {positions.trouble[row]}")
            if self._ranges.malformed:
                parts.append(f"{self._ranges.malformed} sweeps refused, the last because {self._ranges.trouble}")
            notes.append("; ".join(parts))
        return tuple(notes)

    # ------------------------------------------------------------------ what the far end is told

    def _drive(self, row: int, setpoint: messages.Setpoint) -> None:
        with self._lock:
            if self._stopped[row]:
                return  # while the setpoint was decided
            self._put(row, self._command(row, "drive", setpoint))
            if (standing := self._standing.get(row)) is not None and standing.order.action == "takeoff":
                del self._standing[row]  # who is steered need not climb

    def _order(self, row: int, action: Action, seconds: float, height: float | None = None) -> None:
        """Says an order now, and again for so long."""
        with self._lock:
            order = self._command(row, action, height=height)
            self._standing[row] = _Standing(order, self._now() + seconds)
            self._put(row, order)

    def _command(
        self, row: int, action: Action, setpoint: messages.Setpoint | None = None, height: float | None = None
    ) -> messages.Command:
        self._sent[row] += 1
        return messages.Command(self._names[row], self._sent[row], self._stamp(), action, setpoint, height)

    def _put(self, row: int, command: messages.Command) -> None:
        if self._session is None:
            return  # `stop` may come after `close`
        try:
            publishers = self._setpoints if command.action == "drive" else self._orders
            publishers[row].put(messages.encode(command))
        except zenoh.ZError as error:
            self._positions.trouble[row] = f"cannot be told anything: {error}"


def open_external(request: BodyRequest) -> ExternalBody:
    """The entry point `external` of the group `zenpark.bodies`.

    Raises:
        BodyError: If a row has settings.
    """
    return ExternalBody(request)
