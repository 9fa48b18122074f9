"""Body in another process, a simulator or a robot: commands go out on one key, positions come in on another.

The contract is `docs/external-simulators.md`; it requires nothing that a simulator could not know.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Annotated, Final, Literal

import msgspec
import zenoh
from msgspec import Meta

from agents.body.external_pose import External
from agents.body.interface import UNANSWERED, UNANSWERED_S, Body, BodyError, BodyRequest, BodyState, settings
from agents.body.measured_positions import MeasuredPositions
from agents.clock import uptime, wait_until
from agents.errors import ExplainedError
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.shutdown import leave
from agents.runtime.range_inbox import RangeInbox
from agents.safety.preflight import FLOOR_M
from agents.ticks import POLL_S
from agents.vectors import NO_SETPOINT, ZERO, Setpoint, Vector, norm
from bridges.measured_flight import FRESH_S, SETTLED, MeasuredFlight

Action = Literal["drive", "takeoff", "land", "stop"]

OPEN_S: Final = 5.0  # deadline of the router's answer and of the first position of every row
WORLD: Final = "world"  # the address of robots in the shared world process
REPEAT_S: Final = 0.1  # period of a stop that is obeyed: a simulator that is restarted must know of it
HALT_S: Final = 3.0  # time for which `land` is repeated to a robot on wheels, and each stop on every tick
SUPERSEDED_S: Final = 1.0  # a shorter standstill costs no process its name
STANDSTILL_S: Final = 1.0  # longest wait of `close` until stopped robots are measured to stand still


@dataclass(slots=True)
class _ExternalRobot:
    """Last state of a robot, and its orders."""

    name: str
    address: str
    flies: bool
    steers: bool  # True for one that steers by its yaw: setpoints are twists
    # grows over restarts: a simulator that outlives this process can tell new orders from old
    seq: int
    yaw: float  # last measured [rad],
    yaw_at: float = -inf  # time of that yaw
    pose: External = field(default_factory=External)
    flight: MeasuredFlight = field(default_factory=MeasuredFlight)
    stopped_since: float = inf
    # order repeated under its own sequence number until it is completed, not begun: the simulator may be restarted
    # half-way through a climb or a landing, and then knows no earlier order
    repeated: messages.Command | None = None
    repeated_until: float = inf  # latest end [s]

    @property
    def stopped(self) -> bool:
        return self.stopped_since < inf

    @property
    def measured(self) -> float:
        """Time of the pose; a robot that steers by its yaw has no newer pose than that."""
        at = self.pose.time
        return self.yaw_at if self.steers and self.yaw_at < at - FRESH_S else at

    def velocity(self, now: float) -> Vector:
        """Velocity [m/s]; a robot on wheels without positions stands some time after a halt."""
        stands = not self.flies and now - self.flight.landing_since > HALT_S and now - self.pose.time > FRESH_S
        return ZERO if stands else self.pose.velocity

    def adopt_flight(self) -> None:
        """Count a robot in the air, or on its way down, as flying: of a former process, which has died there."""
        x, y, z = self.pose.position
        if self.flies and not self.flight.flying and (z > FLOOR_M or self.pose.velocity[2] < -SETTLED):
            self.flight.take_off((x, y, 0.0))

    def goes_on(self, now: float) -> bool:
        """Whether the robot was stopped, and is not measured to stand."""
        return self.stopped and (self.flight.flying or norm(self.velocity(now)) > SETTLED)

    def obeys(self, now: float) -> bool:
        """Whether a stop has certainly arrived; motors may be on, or wheels turn, without a measured motion."""
        return now - self.stopped_since > HALT_S and not self.goes_on(now)


class ExternalSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `device` table of a robot in another process: nothing but what the world reads of it."""

    watchdog_s: Annotated[float, Meta(gt=0)] | None = None  # see `WorldTable.wheel_watchdog_s` [s]


class ExternalBody(Body):
    """Robots of another process.

    Its own clock is `uptime` and starts at creation; `read` measures the offset of the caller's clock.
    """

    SETTINGS = ExternalSettings

    def __init__(self, request: BodyRequest, open_timeout: float = OPEN_S) -> None:
        """Create the body, still closed; raises BodyError if a row has other settings than `SETTINGS`.

        `open_timeout` is the limit for the router and for the first position of every row [s].
        """
        for name, device in zip(request.names, request.device, strict=True):
            settings(ExternalSettings, name, device)
        self._names, self._keys, self._endpoints = request.names, request.keys, request.endpoints
        self._zero, self._open_timeout = uptime(), open_timeout
        self._clock, self._corrected = request.clock, request.clock.correction_s
        self._utc = request.clock.utc()  # one reading, as in the runtime: a step of the wall clock has no effect
        self._clock_offset = inf  # offset from the caller's clock to this one [s]
        self._robots = [
            _ExternalRobot(name, address, kind.flies, kind.takes == "twist", round(1e3 * self._utc), yaw)
            for name, address, kind, yaw in zip(
                request.names, request.addresses, request.kinds, request.yaw, strict=True
            )
        ]
        self._read_at = inf  # last call of `read`
        self._next_repeat = 0.0
        self._lock = threading.Lock()  # guards the sequence numbers: other threads call `land` and `stop`
        self._session: zenoh.Session | None = None

    # ------------------------------------------------------------------ Body

    def open(self) -> None:
        deadline = time.monotonic() + self._open_timeout
        try:
            name = f"body of {'+'.join(self._names)}"
            self._session = network.open_session(
                self._endpoints, name=name, wait_s=self._open_timeout, identity=self._names[0]
            )
        except ExplainedError as error:
            raise BodyError(f"{', '.join(self._names)}: {error}") from None
        session, keys = self._session, self._keys
        mime = messages.MIME["json"]
        rows = range(len(self._names))
        self._positions = MeasuredPositions(
            session, keys, self._names, rows, validation.ANY_ROOM, exact=rows, silence_s=FRESH_S
        )
        self._ranges = RangeInbox(session, keys, self._names, rows)
        self._setpoints = [pubsub.publisher(session, keys.setpoint(name), mime) for name in self._names]
        self._orders = [
            pubsub.publisher(session, keys.setpoint(name), mime, zenoh.Priority.REAL_TIME) for name in self._names
        ]
        wait_until(lambda: not self._missing_positions(), deadline - time.monotonic())
        if missing := self._missing_positions():
            self.close()
            raise BodyError("\n".join(missing))

    def read(self, t: float) -> Sequence[BodyState]:
        self._outnumber_successor()
        self._clock_offset = min(self._clock_offset, self._now() - t)  # a late call only makes the difference larger
        self._read_positions()
        self._update_flying()
        now, offset = self._now(), self._clock_offset
        states = [
            BodyState(
                robot.measured - offset,
                robot.pose.position,
                robot.velocity(now),
                robot.yaw,
                flying=robot.flight.flying,
                ahead=self._positions.sources[row].ahead,
                note=self._note(row, now),
            )
            for row, robot in enumerate(self._robots)
        ]
        self._ranges.replace_scans(states, self._utc + offset, t)
        return states

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        for row, setpoint in enumerate(setpoints):
            if all(map(isfinite, setpoint)):
                self._send_setpoint(row, setpoint)
        if any(robot.repeated is not None for robot in self._robots):
            self._repeat_orders(self._now())

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """See `Body.takeoff`; no effect on ground robots, or after a stop."""
        for row, up in zip(rows, heights, strict=True):
            robot = self._robots[row]
            if robot.flies and not robot.stopped:
                robot.flight.take_off(robot.pose.position)
                self._send_order(row, "takeoff", inf, up)

    def land(self, rows: Sequence[int]) -> None:
        """See `Body.land`; no effect after a stop."""
        for row in rows:
            robot = self._robots[row]
            if not robot.stopped:
                robot.adopt_flight()
                robot.flight.land(self._now())
                self._send_order(row, "land", inf if robot.flight.flying else HALT_S)

    def stop(self, rows: Sequence[int]) -> None:
        """See `Body.stop`; repeated as long as this process lives."""
        for row in rows:
            robot = self._robots[row]
            if not robot.stopped:
                robot.stopped_since = now = self._now()
                robot.adopt_flight()
                # from now on the robot counts as flying until it is measured on the ground
                robot.flight.land(now)
                self._send_order(row, "stop", inf)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        """No effect: this body subscribes to the key `position` itself."""

    def close(self) -> None:
        if self._session is not None:
            until, nothing = self._now() + STANDSTILL_S, [NO_SETPOINT] * len(self._robots)
            while (now := self._now()) < until and any(robot.goes_on(now) for robot in self._robots):
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
            robot = self._robots[row]
            if robot.pose.update(taken, position, yaw) and isfinite(yaw):
                robot.yaw, robot.yaw_at = yaw, taken

    def _missing_positions(self) -> list[str]:
        """Diagnosis and remedy for each robot without a usable position."""
        self._read_positions()
        now, found = self._now(), []
        for row, robot in enumerate(self._robots):
            name, age = robot.name, now - robot.pose.time
            key = self._keys.position(name)
            source = "`./zenpark world serve` with this experiment" if robot.address == WORLD else "the simulator"
            if not isfinite(age):
                found.append(
                    f"{name}: samples on {key} are not positions: {self._positions.sources[row].inbox.trouble}"
                    if self._positions.sources[row].inbox.malformed
                    else f"{name}: nothing is published on {key}: is {source} running and connected to "
                    f"{', '.join(self._endpoints)}?"
                )
            elif age > FRESH_S:
                found.append(
                    f"{name}: the position on {key} was measured {age:.1f} s ago by its stamp: stamps are UTC seconds, "
                    "not simulation time; if they are UTC, set the clocks of both computers"
                )
            elif robot.steers and not isfinite(robot.pose.yaw):
                found.append(f"{name}: the position on {key} has no yaw, without which a robot on wheels cannot steer")
        return found

    def _update_flying(self) -> None:
        """Update which robots fly; orders to robots that are down are complete."""
        now = self._now()
        for robot in self._robots:
            pose, climbing = robot.pose, robot.repeated is not None
            if robot.flight.update(now, pose.time, pose.position, pose.velocity, climbing=climbing):
                with self._lock:
                    if not robot.stopped:
                        robot.repeated = None

    def _note(self, row: int, now: float) -> str:
        robot, positions = self._robots[row], self._positions.sources[row].inbox
        parts = [UNANSWERED] if now - robot.stopped_since > UNANSWERED_S and robot.goes_on(now) else []
        if (age := now - robot.measured) > FRESH_S:
            what = "yaw" if robot.measured < robot.pose.time else "position"
            parts.append(f"no {what} for {age:.0f} s")
        if positions.malformed:
            parts.append(f"{positions.malformed} positions refused, the last because {positions.trouble}")
        if self._ranges.malformed:
            parts.append(f"{self._ranges.malformed} sweeps refused, the last because {self._ranges.trouble}")
        return "; ".join(parts)

    # ------------------------------------------------------------------ commands sent

    def _send_setpoint(self, row: int, setpoint: Setpoint) -> None:
        robot = self._robots[row]
        with self._lock:
            if robot.stopped:
                return
            self._put(row, self._next_command(robot, "drive", setpoint))
            if robot.repeated is not None and robot.repeated.action == "takeoff":
                robot.repeated = None  # setpoints replace a take-off

    def _send_order(self, row: int, action: Action, seconds: float, height: float | None = None) -> None:
        """Send an order now, and repeat it for `seconds`."""
        robot = self._robots[row]
        with self._lock:
            if action != "stop" and robot.stopped:
                return  # stopped meanwhile, by another thread
            order = self._next_command(robot, action, height=height)
            robot.repeated, robot.repeated_until = order, self._now() + seconds
            self._put(row, order)

    def _repeat_orders(self, now: float) -> None:
        """Repeat orders on every tick, as setpoints are: each may be lost, and motors are on until one arrives."""
        if due := now >= self._next_repeat:
            self._next_repeat = now + REPEAT_S
        with self._lock:
            for row, robot in enumerate(self._robots):
                repeated = robot.repeated
                if repeated is None:
                    continue
                if now > robot.repeated_until:
                    robot.repeated = None
                elif due or not robot.obeys(now):
                    self._put(row, msgspec.structs.replace(repeated, stamp=self._stamp()))

    def _outnumber_successor(self) -> None:
        """After a standstill, go on with numbers beyond those of a process that had the name meanwhile."""
        before, self._read_at = self._read_at, self._now()
        if self._read_at - before > SUPERSEDED_S:
            least = round(1e3 * (self._utc + self._read_at))
            with self._lock:
                for robot in self._robots:
                    robot.seq = max(robot.seq, least)

    def _next_command(
        self, robot: _ExternalRobot, action: Action, setpoint: Setpoint | None = None, height: float | None = None
    ) -> messages.Command:
        robot.seq += 1
        return messages.Command(robot.name, robot.seq, self._stamp(), action, setpoint, height)

    def _put(self, row: int, command: messages.Command) -> None:
        if self._session is None:
            return  # `stop` may be called after `close`
        try:
            publishers = self._setpoints if command.action == "drive" else self._orders
            publishers[row].put(messages.encode(command))
        except zenoh.ZError as error:
            self._positions.sources[row].inbox.trouble = f"commands cannot be sent: {error}"
