"""One DJI Tello as its pilot sees it: what is wanted of it, what was said to it, what it says of itself.

djitellopy's blocking calls are not used: they wait seconds for an answer, take a late one for that of the next
command, and repeat relative moves. A pilot sends without waiting, and says again what was not answered.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from enum import Enum
from typing import Any, Final, Protocol

from agents.body.interface import FRESH_S, UNANSWERED
from agents.body.kinds import Kind
from agents.protocols import tello as protocol

ASK_S: Final = 0.5  # between two attempts to enter SDK mode
INSIST_S: Final = 1.0  # between two `land` that are not answered
REPEAT_TAKEOFF_S: Final = 6.0  # likewise of `takeoff`, to which a drone answers when it is up
QUICKEST_S: Final = 1.0  # no drone is up before
TAKEOFF_S: Final = 20.0  # then it will not fly any more
LAST: Final = 5  # the last command of a process is sent so many times, for a datagram may be lost
STOOD_S: Final = 1.5  # its motors stand when the seconds that it counts while they run stay the same for so long,
CUT_S: Final = 2.5  # which is known so long after an emergency stop, if that was heard
ATTENDED_S: Final = 2.0  # a process that did not read for longer does not drive its robots: they land
STILL_S: Final = 3.0  # low for this long, motors not running: it is on the ground
GONE_S: Final = 20.0  # silent for this long: it has landed by itself
LOW: Final = 30  # [cm] the height that it reports is rounded and drifts

STILL: Final = (0, 0, 0, 0)


class Vendor(Protocol):
    """What is used of `djitellopy.Tello`."""

    def send_rc_control(self, right: int, forward: int, up: int, clockwise: int, /) -> None: ...
    def send_command_without_return(self, command: str, /) -> None: ...
    def get_current_state(self) -> dict[str, Any]: ...
    def get_own_udp_object(self) -> dict[str, Any]: ...
    def end(self) -> None: ...


class Duty(Enum):
    """What a drone is wanted to do."""

    REST = "on the ground"
    RISE = "taking off"
    HOLD = "climbing to its height"
    FLY = "as the setpoints say"
    LAND = "landing"
    CUT = "motors off"


class Pilot:
    """One drone: what is wanted of it, what was said to it, what it says of itself. Times are monotonic [s].

    Attributes:
        duty: What it is wanted to do.
        heard: When its last state came; minus infinity before the first.
        battery: Charge, 0 to 1.
        turned: Its own yaw since it was opened, counter-clockwise [rad].
        trouble: What went wrong last, for people.
        position: (3,) from outside [m]; NaN if there is no fresh one.
        yaw: From outside, or else its own [rad].
        setpoint: Velocity in the world and yaw rate.
        set_at: When that was given.
    """

    def __init__(self, drone: Vendor, kind: Kind, chosen: protocol.Settings) -> None:
        self._drone, self._kind, self._settings = drone, kind, chosen
        self.duty = Duty.REST
        self.heard = -math.inf
        self.battery, self.turned, self.trouble = math.nan, 0.0, ""
        self.position, self.yaw = (math.nan,) * 3, 0.0
        self.setpoint, self.set_at = (0.0,) * 4, -math.inf
        self.place = (math.nan,) * 3  # that it climbs to and holds until setpoints come
        self._state: Mapping[str, Any] = {}
        self._zero_yaw: int | None = None
        self._height, self._motors = 0, -1
        self._running = self._aloft = -math.inf  # when the motors' clock last moved, when it was last not low
        self._began = self._said = self._proof = -math.inf
        self._unsent = ""

    @property
    def flying(self) -> bool:
        """Motors on, as far as is known: until the drone says that they stand."""
        return self.duty is not Duty.REST

    def silent(self, now: float) -> bool:
        """Whether its state has not come for too long."""
        return now - self.heard > self._settings.silence_s

    def note(self, now: float) -> str:
        """What people should know of it; empty if all is well."""
        if self.heard == -math.inf:
            return self._unsent or "no answer"
        unanswered = UNANSWERED if self.duty is Duty.CUT and now - self._began > CUT_S else ""
        silence = f"silent for {now - self.heard:.0f} s (off, out of reach, or taken over)" if self.silent(now) else ""
        return "; ".join(part for part in (unanswered, self._unsent, silence, self.trouble) if part)

    # ------------------------------------------------------------------ what is wanted

    def rise(self, height: float, now: float) -> None:
        """Take off, then climb to `height` [m] over this place; a drone that cannot says why."""
        if self.duty is not Duty.REST:
            return
        if self.silent(now):
            self.trouble = "does not take off: no state comes from it"
        elif not math.isfinite(self.position[0]):
            self.trouble = "does not take off: no fresh external position; is the positioning system running?"
        elif self.battery < self._settings.low_battery:
            self.trouble = f"does not take off: battery at {self.battery:.0%}"
        else:
            self.place = (self.position[0], self.position[1], height)
            self.trouble = ""
            self._begin(Duty.RISE, "takeoff", now)

    def land(self, now: float, why: str = "") -> None:
        """Come down here."""
        if self.duty in (Duty.RISE, Duty.HOLD, Duty.FLY):
            self.trouble = why or self.trouble
            self._begin(Duty.LAND, "land", now)

    def cut(self, now: float) -> None:
        """Motors off: said again until the drone says that they stand, or has been silent for `GONE_S`."""
        if self.duty is not Duty.CUT:
            self._proof = -math.inf if self.duty is Duty.REST else now
            self._began = now
        self.duty = Duty.CUT
        self._say("emergency", now)

    def leave(self) -> None:
        """Nobody flies it any more: what is in the air is told to land, and the library to forget it."""
        last = "emergency" if self.duty is Duty.CUT else "land" if self.flying else ""
        try:
            for _ in range(LAST if last else 0):
                self._send(last)
                time.sleep(0.02)
        finally:
            self._drone.end()

    # ------------------------------------------------------------------ the thread

    def step(self, now: float, attended: float) -> None:
        """Hears, and says what is due; `attended` is when the process last read the state."""
        self._listen(now)
        if self.duty is Duty.REST:
            if self.silent(now) and now - self._said >= ASK_S:
                self._say("command", now)
        elif now - self.heard > GONE_S:
            self.duty, self.trouble = Duty.REST, "it must have landed by itself"
        elif self.duty is Duty.CUT:
            if self._stands():
                self.duty = Duty.REST
            else:
                self._send("emergency")
        elif self.duty is Duty.RISE:
            self._rise(now)
        elif self.duty is Duty.LAND:
            if self._down(now):  # the answer was lost
                self.duty = Duty.REST
            elif now - self._said >= INSIST_S:
                self._say("land", now)
        else:
            self._fly(now, attended)

    def _stands(self) -> bool:
        """Whether a state that came long enough after its motors' clock moved last, and after the stop, shows the same.

        A firmware that does not say that clock must have been low for as long.
        """
        ran = self._running if self._motors >= 0 else self._aloft
        return self.heard - max(ran, self._proof) > STOOD_S

    def _down(self, now: float) -> bool:
        """Whether what it says of itself leaves no doubt that it stands on the ground."""
        return not self.silent(now) and now - max(self._aloft, self._running) > STILL_S

    def _fly(self, now: float, attended: float) -> None:
        if now - attended > ATTENDED_S:
            self.land(now, f"landing: its process did nothing for {ATTENDED_S:.0f} s")
        elif self.battery < self._settings.low_battery:
            self.land(now, f"landing: battery at {self.battery:.0%}")
        elif self._down(now):
            self.duty, self.trouble = Duty.REST, f"it has landed by itself, battery at {self.battery:.0%}"
        else:
            try:
                self._drone.send_rc_control(*self._sticks(now, attended))
            except OSError as error:
                self._unsent = f"cannot send: {error.strerror}"

    def _rise(self, now: float) -> None:
        if now - self._began > TAKEOFF_S:
            self.land(now, f"did not take off in {TAKEOFF_S:.0f} s")
        elif self._aloft > self._began and now - self._said > REPEAT_TAKEOFF_S:
            self._up(now)  # the answer was lost
        elif now - self._said > REPEAT_TAKEOFF_S:
            self._say("takeoff", now)

    def _up(self, now: float) -> None:
        self.duty = Duty.HOLD
        self._running = self._aloft = now

    def _sticks(self, now: float, attended: float) -> tuple[int, int, int, int]:
        """Toward the place to hold, as the setpoint says, or at rest where neither is fresh."""
        if now - attended > FRESH_S:
            return STILL
        if self.duty is Duty.FLY and now - self.set_at <= FRESH_S:
            x, y, z, turn = self.setpoint
            return protocol.sticks((x, y, z), turn, self.yaw)
        if self.duty is Duty.HOLD and math.isfinite(self.position[0]):
            limit, response = self._kind.speed, self._kind.response
            x, y, z = (
                max(-limit, min(limit, response * (there - here)))
                for there, here in zip(self.place, self.position, strict=True)
            )
            return protocol.sticks((x, y, z), 0.0, self.yaw)
        return STILL

    def _listen(self, now: float) -> None:
        state = self._drone.get_current_state()
        if state is not self._state and state:  # the library stamps nothing, but makes a new table of each state line
            self._state, self.heard, self._unsent = state, now, ""
            self._learn(state, now)
        answers: list[bytes] = self._drone.get_own_udp_object()["responses"]
        while answers:
            self._take(answers.pop(0).decode("ascii", "replace").strip(), now)

    def _learn(self, state: Mapping[str, Any], now: float) -> None:
        charge, yaw, height, motors = (state.get(key) for key in ("bat", "yaw", "h", "time"))
        if isinstance(charge, int) and 0 <= charge <= 100:  # text over UDP can be anything
            self.battery = 0.01 * charge
        if isinstance(yaw, int) and abs(yaw) <= 360:
            self._zero_yaw = yaw if self._zero_yaw is None else self._zero_yaw
            self.turned = -math.radians(yaw - self._zero_yaw)
        if isinstance(height, int):
            self._height = height
            if height >= LOW:
                self._aloft = now
        if isinstance(motors, int) and motors != self._motors:
            self._motors, self._running = motors, now

    def _take(self, answer: str, now: float) -> None:
        """An answer, believed only where it fits: `command`, `emergency` and some firmware's `rc` are answered too."""
        refused = answer.startswith(("error", "out of range", "unknown"))
        if self.duty is Duty.RISE:
            if (answer == "ok" and now - self._began > QUICKEST_S) or (refused and self._aloft > self._began):
                self._up(now)  # told twice, it refuses the second time
            elif refused:
                self.duty, self.trouble = Duty.REST, f"refuses to take off: {answer!r}, battery at {self.battery:.0%}"
        elif self.duty is Duty.LAND and (answer == "ok" or refused) and self._height < LOW:
            self.duty = Duty.REST

    def _begin(self, duty: Duty, command: str, now: float) -> None:
        self.duty, self._began = duty, now
        self._say(command, now)

    def _say(self, command: str, now: float) -> None:
        """Sends a command whose answer matters: what came before it is none."""
        self._said = now
        self._drone.get_own_udp_object()["responses"].clear()
        self._send(command)

    def _send(self, command: str) -> None:
        try:
            self._drone.send_command_without_return(command)
        except OSError as error:
            self._unsent = f"cannot send: {error.strerror}"
