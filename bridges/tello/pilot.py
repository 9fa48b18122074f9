"""Control of one DJI Tello: current duty, commands sent, state received.

djitellopy's blocking calls are not used: they wait seconds for an answer, take a late answer for that of the next
command, and repeat relative moves. A pilot sends without waiting, and repeats commands without an answer. A refused
`land` is repeated too: only the state of a drone, or an `ok` near the floor, shows that it has landed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, Protocol

from agents.body.interface import FRESH_S, UNANSWERED
from agents.body.kinds import Kind
from agents.clock import uptime
from bridges.tello import protocol

SDK_RETRY_S: Final = 0.5  # pause between two attempts to enter SDK mode
LAND_RETRY_S: Final = 1.0  # pause between two `land` without an answer
LAND_SOON_S: Final = 0.2  # pause in the first second, until the drone descends: it may have kept its last sticks
TAKEOFF_RETRY_S: Final = 6.0  # likewise of `takeoff`, which a drone answers when it is up
SHORTEST_TAKEOFF_S: Final = 1.0  # no drone is up earlier
TAKEOFF_S: Final = 20.0  # time after which the take-off has failed
LAST_REPEATS: Final = 5  # transmissions of the last command of a process: a datagram may be lost
MOTORS_STOPPED_S: Final = 1.5  # time of a constant counter of motor seconds after which the motors stand still,
CUT_S: Final = 2.5  # time after a received emergency stop at which this is known
UNREAD_S: Final = 2.0  # drones land when their process has not read the state for longer
ON_GROUND_S: Final = 3.0  # low for this long, motors not running: on the ground
LANDED_ALONE_S: Final = 20.0  # silent for this long: landed by itself
LOW: Final = 30  # [cm] the reported height is rounded and drifts
TOO_HIGH_M: Final = 1.0  # [m] excess over the end of its climb: its positions are those of something else
UNORDERED: Final = 3  # seconds on the motors' clock of a high drone that rests: it flies without an order
REFUSED: Final = "no take-off: "
REFUSALS: Final = 3  # answers in a row that refuse the sticks: the note says so
REFUSED_S: Final = 1.0  # time after the last of them for which it does

ZERO_STICKS: Final = (0, 0, 0, 0)


class Vendor(Protocol):
    """The part of `djitellopy.Tello` that is used."""

    def send_command_without_return(self, command: str, /) -> None: ...
    def get_current_state(self) -> dict[str, Any]: ...
    def get_own_udp_object(self) -> dict[str, Any]: ...
    def end(self) -> None: ...


class Duty(Enum):
    """Task of a drone."""

    REST = "on the ground"
    RISE = "taking off"
    HOLD = "climbing to its height"
    FLY = "following setpoints"
    LAND = "landing"
    CUT = "motors off"


class TelloPilot:
    """One drone: duty, commands sent, state received. Times are those of `uptime` [s]."""

    def __init__(
        self, drone: Vendor, kind: Kind, chosen: protocol.TelloSettings, clock: Callable[[], float] = uptime
    ) -> None:
        self._drone, self._kind, self._settings, self._clock = drone, kind, chosen, clock
        self.duty = Duty.REST
        self.state_received = -math.inf  # time of the last state; -inf before the first
        self.battery = math.nan  # charge, 0 to 1
        self.turned = 0.0  # yaw by its own sensors since `open`, counter-clockwise [rad]
        self.trouble = ""  # last fault, for users
        self.position = (math.nan,) * 3  # external [m]; NaN unless fresh
        self.yaw = 0.0  # external, else its own [rad]
        self.setpoint, self.setpoint_time = (0.0,) * 4, -math.inf  # velocity in the world [m/s], yaw rate [rad/s]
        self.hold_position = (math.nan,) * 3  # [m] goal of the climb, held until setpoints come
        self._floor = math.nan  # [m] external height at the take-off
        self._state: Mapping[str, Any] = {}
        self._zero_yaw: int | None = None
        self._height, self._motors = 0, -1
        self._landed_from = 0  # [cm] height at the order to land
        self._running = self.aloft = -math.inf  # last motion of the motors' clock, last time that it was not low
        self._began_at = self._sent_at = self._cut_at = self._up_at = self._ordered_up_at = -math.inf
        self._rested = 0  # seconds on the motors' clock since the drone rests
        self._refusals, self._refusal = 0, ""  # refusals of the sticks: number, last answer
        self._refused_at = -math.inf  # time of the last one [s]
        self._send_error = ""

    @property
    def flying(self) -> bool:
        """Motors on, as far as known: until the drone reports that they stand."""
        return self.duty is not Duty.REST

    def silent(self, now: float) -> bool:
        """Whether the last state is too old."""
        return now - self.state_received > self._settings.silence_s

    def note(self, now: float) -> str:
        """Faults for users; empty if none."""
        if self.state_received == -math.inf:
            return self._send_error or "no answer"
        unanswered = UNANSWERED if self.duty is Duty.CUT and now - self._began_at > CUT_S else ""
        silence = (
            f"silent for {now - self.state_received:.0f} s (off, out of reach, or taken over)"
            if self.silent(now)
            else ""
        )
        refused = (
            f"refuses the sticks, {self._refusals} times: {self._refusal!r}"
            if self._refusals >= REFUSALS and now - self._refused_at < REFUSED_S
            else ""
        )
        trouble = "" if self.trouble.startswith(REFUSED) and not self._takeoff_refusal(now) else self.trouble
        return "; ".join(part for part in (unanswered, self._send_error, silence, refused, trouble) if part)

    # ------------------------------------------------------------------ orders

    def take_off(self, height: float, now: float) -> None:
        """Take off, then climb to `height` [m] above this place; on refusal, `trouble` gives the reason."""
        if self.duty is not Duty.REST:
            return
        self.trouble = self._takeoff_refusal(now)
        if not self.trouble:
            self.hold_position = (self.position[0], self.position[1], height)
            self._floor, self._refusals = self.position[2], 0
            self._begin(Duty.RISE, "takeoff", now)

    def _takeoff_refusal(self, now: float) -> str:
        """Reason against a take-off; empty if none."""
        if self.silent(now):
            return f"{REFUSED}no state received"
        if not math.isfinite(self.position[0]):
            return f"{REFUSED}no fresh external position; is the positioning system running?"
        low = self.battery < self._settings.low_battery
        return f"{REFUSED}battery at {self.battery:.0%}" if low else ""

    def land(self, now: float, reason: str = "") -> None:
        """Land at the current place; `reason` is for users."""
        if self.duty in (Duty.RISE, Duty.HOLD, Duty.FLY):
            self.trouble = reason or self.trouble
            self._landed_from = self._height
            self._rest_sticks()
            self._begin(Duty.LAND, "land", now)

    def cut(self, now: float) -> None:
        """Cut the motors: repeated until the drone reports that they stand, or is silent for `LANDED_ALONE_S`."""
        if self.duty is not Duty.CUT:
            self._cut_at = -math.inf if self.duty is Duty.REST else now
            self._began_at = now
        self.duty = Duty.CUT
        self._send_and_await("emergency", now)

    def fail(self, error: Exception) -> None:
        """Note the error of a failed step; a drone in the air is landed from the next step on."""
        self.trouble = f"cannot be driven: {type(error).__name__}: {error}"
        if self.duty in (Duty.RISE, Duty.HOLD, Duty.FLY):
            self.duty, self._sent_at = Duty.LAND, -math.inf

    def leave(self) -> None:
        """End the pilot: land or stop a drone in the air, and release the library's object."""
        try:
            if self.duty in (Duty.HOLD, Duty.FLY):
                self._rest_sticks()
            for _ in range(LAST_REPEATS if self.flying else 0):
                self._send("emergency" if self.duty is Duty.CUT else "land")  # it may be stopped meanwhile
                time.sleep(0.02)
        finally:
            self._drone.end()

    # ------------------------------------------------------------------ the thread

    def step(self, now: float, last_read: float) -> None:
        """Process received state and answers, send due commands; `last_read`: the process's last read of the state."""
        try:
            self._receive(now)
        finally:
            self._act(now, last_read)

    def _act(self, now: float, last_read: float) -> None:
        """Send due commands."""
        if self.duty is Duty.REST:
            self._watch_rest(now)
        elif now - self.state_received > LANDED_ALONE_S:
            self._rest("silent: must have landed by itself")
        elif self.duty is Duty.CUT:
            if self._motors_stopped():
                self._rest(self.trouble)
            else:
                self._send("emergency")
        elif self.duty is Duty.RISE:
            self._take_off(now, last_read)
        elif self.duty is Duty.LAND:
            if self._on_ground(now):  # the answer was lost
                self._rest(self.trouble)
            else:
                self._repeat_landing(now)
        else:
            self._send_sticks(now, last_read)

    def _watch_rest(self, now: float) -> None:
        """Enter SDK mode; stop and land a drone that flies all the same, such as one of a process that was killed."""
        unheard = self._sent_at == -math.inf or self.silent(now)
        if unheard and now - self._sent_at >= SDK_RETRY_S:
            self._send_and_await("command", now)
            self._rest_sticks()
        elif self._rested >= UNORDERED and self._height >= LOW:
            self.trouble = "landing: it flew without an order"
            self._begin(Duty.LAND, "land", now)

    def _motors_stopped(self) -> bool:
        """Whether the counter of motor seconds has been constant long enough, also since the stop.

        For a firmware without that counter: whether the drone has been low for as long.
        """
        ran = self._running if self._motors >= 0 else self.aloft
        return self.state_received - max(ran, self._cut_at) > MOTORS_STOPPED_S

    def _on_ground(self, now: float) -> bool:
        """Whether the drone's state proves that it is on the ground, and has not begun a take-off."""
        return not self.silent(now) and now - max(self.aloft, self._running, self._ordered_up_at) > ON_GROUND_S

    def _repeat_landing(self, now: float) -> None:
        """Order the landing again when it is due; a drone that descends is left alone for longer."""
        ignored = now - self._began_at < LAND_RETRY_S and self._height >= self._landed_from
        if now - self._sent_at >= (LAND_SOON_S if ignored else LAND_RETRY_S):
            if ignored or self._sent_at == -math.inf:  # a step has failed
                self._rest_sticks()
            self._send_and_await("land", now)

    def _rest(self, trouble: str) -> None:
        self.duty, self.trouble = Duty.REST, trouble
        self._rested = 0

    def _send_sticks(self, now: float, last_read: float) -> None:
        if now - last_read > UNREAD_S:
            self._land_unattended(now)
        elif self.battery < self._settings.low_battery:
            self.land(now, f"landing: battery at {self.battery:.0%}")
        elif self.duty is Duty.HOLD and 0.01 * self._height > self.hold_position[2] - self._floor + TOO_HIGH_M:
            self.land(now, f"landing: it is {0.01 * self._height:.1f} m high, and its positions do not rise with it")
        elif self._on_ground(now):
            self._rest(f"landed by itself, battery at {self.battery:.0%}")
        else:
            right, forward, up, clockwise = self._sticks(now, last_read)
            if self._clock() - now <= FRESH_S:  # else the process stood still meanwhile
                self._send(f"rc {right} {forward} {up} {clockwise}")

    def _rest_sticks(self) -> None:
        """Centre the sticks, which a drone keeps while it does not land."""
        self._send("rc 0 0 0 0")

    def _land_unattended(self, now: float) -> None:
        self.land(now, f"landing: its process did nothing for {UNREAD_S:.0f} s")

    def _take_off(self, now: float, last_read: float) -> None:
        if now - last_read > UNREAD_S:
            self._land_unattended(now)
        elif now - self._began_at > TAKEOFF_S:
            self.land(now, f"did not take off in {TAKEOFF_S:.0f} s")
        elif self.aloft > self._began_at and now - self._sent_at > TAKEOFF_RETRY_S:
            self._airborne(now)  # the answer was lost
        elif now - self._sent_at > TAKEOFF_RETRY_S:
            self._send_and_await("takeoff", now)

    def _airborne(self, now: float) -> None:
        self.duty, self._up_at = Duty.HOLD, now
        self._running = self.aloft = now

    def _sticks(self, now: float, last_read: float) -> tuple[int, int, int, int]:
        """Stick values for the setpoint or toward the position to hold; zeros if neither is fresh."""
        if now - last_read > FRESH_S:
            return ZERO_STICKS
        scale = self._settings.stick_speed
        if self._settings.stick_test and (test := protocol.stick_test(now - self._up_at, scale)) is not None:
            return test if math.isfinite(self.position[0]) else ZERO_STICKS
        if self.duty is Duty.FLY and now - self.setpoint_time <= FRESH_S:
            x, y, z, turn = self.setpoint
            return protocol.sticks((x, y, z), turn, self.yaw, scale)
        if self.duty is Duty.HOLD and math.isfinite(self.position[0]):
            limit, response = self._kind.speed, self._kind.response
            x, y, z = (
                max(-limit, min(limit, response * (hold - here)))
                for hold, here in zip(self.hold_position, self.position, strict=True)
            )
            return protocol.sticks((x, y, z), 0.0, self.yaw, scale)
        return ZERO_STICKS

    def _receive(self, now: float) -> None:
        state = self._drone.get_current_state()
        if state is not self._state and state:  # the library has no time stamps, but a new dict for each state line
            self._state, self.state_received = state, now
            self._send_error = ""
            self._store_state(state, now)
        if self.position[2] - self._floor > 0.01 * LOW:  # whatever the drone measures
            self.aloft = now
        answers: list[bytes] = self._drone.get_own_udp_object()["responses"]
        while answers:
            self._process_answer(answers.pop(0).decode("ascii", "replace").strip(), now)

    def _store_state(self, state: Mapping[str, Any], now: float) -> None:
        charge, yaw, height, motors = (state.get(key) for key in ("bat", "yaw", "h", "time"))
        if isinstance(charge, int) and 0 <= charge <= 100:  # text from UDP may hold any value
            self.battery = 0.01 * charge
        if isinstance(yaw, int) and abs(yaw) <= 360:
            self._zero_yaw = yaw if self._zero_yaw is None else self._zero_yaw
            self.turned = -math.radians(yaw - self._zero_yaw)
        if isinstance(height, int):
            self._height = height
            if height >= LOW:
                self.aloft = now
        if isinstance(motors, int) and motors != self._motors:
            self._rested += self._motors >= 0
            self._motors, self._running = motors, now

    def _process_answer(self, answer: str, now: float) -> None:
        """Use an answer where it fits the duty: `command`, `emergency` and some firmware's `rc` are answered too."""
        refused = answer.startswith(("error", "out of range", "unknown"))
        if self.duty is Duty.RISE:
            if (answer == "ok" and now - self._began_at > SHORTEST_TAKEOFF_S) or (
                refused and self.aloft > self._began_at
            ):
                self._airborne(now)  # a drone in the air refuses the second of two commands
            elif refused:
                self._rest(f"refuses to take off: {answer!r}, battery at {self.battery:.0%}")
        elif self.duty is Duty.LAND:
            low = self._height < LOW and self.aloft < now
            if answer == "ok" and low and now - self._ordered_up_at > ON_GROUND_S:
                self._rest(self.trouble)
            elif refused:
                self._rest_sticks()
        elif self.duty in (Duty.HOLD, Duty.FLY) and refused:
            self._refusals = self._refusals + 1
            self._refused_at, self._refusal = now, answer

    def _begin(self, duty: Duty, command: str, now: float) -> None:
        self.duty, self._began_at = duty, now
        self._send_and_await(command, now)

    def _send_and_await(self, command: str, now: float) -> None:
        """Send a command with an answer that is used; discard earlier answers."""
        self._sent_at = now
        if command == "takeoff":
            self._ordered_up_at = now
        self._send(command)
        self._drone.get_own_udp_object()["responses"].clear()

    def _send(self, command: str) -> None:
        try:
            self._drone.send_command_without_return(command)
        except OSError as error:
            self._send_error = f"cannot send: {error.strerror}"
