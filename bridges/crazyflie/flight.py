"""Flight phases of one Crazyflie: take-off, setpoints, landing and stop, in the order that the firmware requires.

Take-offs and landings are computed by the planner on board. Between them setpoints are streamed by default: without
setpoints the firmware levels out after 0.5 s and cuts the motors after 2 s: no failure here leaves a robot in the air.
While the radio stutters, the planner on board holds the place instead: then no gap cuts the motors.

Flags of the supervisor, not answers to commands, tell whether a drone flies: answers may be lost, or wait behind logs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from enum import Enum
from typing import Final

from agents.body.interface import UNANSWERED
from agents.body.kinds import CRAZYFLIE
from agents.protocols.crazyflie import CrazyflieSettings
from agents.protocols.crtp import HighLevel, Info, Status
from bridges.crazyflie.link import CrazyflieLink
from bridges.crazyflie.telemetry import Telemetry

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
GENTLE: Final = 0.15  # [m/s] mean speed of a landing after a gap of the radio: never 0.5 m/s, at the floor neither
SHORTEST_S: Final = 1.5  # duration of a take-off or landing
LONGEST_S: Final = 8.0  # duration of a landing, which others wait 15 s for
REPLY_S: Final = 0.15  # deadline of the reply to a high-level command; then the command is repeated
TRIES: Final = 12
SETPOINT_EVERY: Final = 3  # tries: no setpoint for longer than 0.45 s
ARMING_S: Final = 4.0  # motors that are checked one by one take seconds
STOPPING_S: Final = 2.0  # after a stop, a Crazyflie that does not report "locked" still reports "flying" for so long
ANSWER_S: Final = 2.5  # the note reports an emergency stop that is unconfirmed for longer
POLL_S: Final = 0.02
FRESH_S: Final = 1.0  # an older status is ignored
LOOP_SILENCE_S: Final = 1.0  # in flight, the robot's loop must command at least this often
FLYING_FLAG_S: Final = 3.0  # from a take-off to the flag "flying" in the status
MOVED: Final = 0.01  # [m] goals closer to the last one are not sent to the planner
TURNED: Final = math.radians(2.0)
STUTTER_S: Final = 0.2  # a gap of the radio that is longer hands over to the planner on board,
STEADY_S: Final = 2.0  # which holds the place until no gap was so long for this time
LANDING_GAP_S: Final = 0.8  # after a longer gap the drone is landed: it has flown without control
STUTTERING_S, MOST_GAPS = 10.0, 4  # with more gaps in this time the drone is landed: it would hover out of reach next
HOLD_AGE_S: Final = 0.3  # while the last pose is older, new setpoints are ignored
AGAIN_S: Final = 3.0  # a landing that takes longer than planned by this is ordered again
PEAK: Final = 35.0 / 16.0  # maximum / mean speed of the planner's polynomial from rest to rest
SHORTEST_GO_TO_S: Final = 0.5

ANSWERS: Final[dict[int, str]] = {Status.BUSY: "not armed, or locked", Status.REFUSED: "its planner is busy"}

Target = tuple[float, float, float, float]
Pause = Callable[[float], None]


class Phase(Enum):
    """Flight phase of a Crazyflie; the value is its text for users."""

    GROUND = "on the ground"
    CLIMBING = "taking off"
    FLYING = "flying"
    LANDING = "landing"
    STOPPING = "stop sent, not confirmed yet"
    STOPPED = "stopped"


AIRBORNE: Final = (Phase.CLIMBING, Phase.FLYING, Phase.LANDING, Phase.STOPPING)


class Flight:
    """Flight control of one Crazyflie over its current link; called by its pilot's thread only, except `set_target`."""

    def __init__(self, settings: CrazyflieSettings, telemetry: Telemetry, pause: Pause) -> None:
        """`pause` waits for some seconds; it raises when the link is lost or a stop is ordered."""
        self.link: CrazyflieLink  # current connection; a new one after a loss
        self.phase = Phase.GROUND
        self.trouble = ""  # last fault, for users; empty if none
        self._settings, self._telemetry, self._pause = settings, telemetry, pause
        self._target: Target | None = None
        self._commanded_at = math.inf
        self._since = -math.inf
        self._sent = -math.inf
        self._goal: Target | None = None
        self._held_since = -math.inf  # last gap after which the planner on board was given the drone
        self._descent = CLIMB  # mean speed of the next landing [m/s]
        self._gaps: list[float] = []  # end of each gap of the last seconds [s]
        self._span = 0.0  # duration of the landing [s]

    @property
    def airborne(self) -> bool:
        """Whether the motors are on, as far as known."""
        return self.phase in AIRBORNE

    def set_target(self, now: float, target: Target | None) -> None:
        """Store the setpoint of the robot's loop at `now` [s, monotonic]; None keeps the last one. From any thread."""
        self._commanded_at = now
        if target is not None and self._telemetry.pose_age < HOLD_AGE_S:
            self._target = target

    def publish_airborne(self) -> None:
        """Write `airborne` to the board."""
        self._telemetry.board.airborne[self._telemetry.row] = self.airborne

    # ------------------------------------------------------------------ orders

    def takeoff(self, height: float) -> None:
        """Climb to `height` [m] above the ground here; on refusal, `trouble` gives the reason."""
        if self.airborne:
            return
        self._held_since, self._descent = -math.inf, CLIMB
        self.trouble = self.takeoff_refusal() or self._arm()
        if self.trouble:
            return
        self._end_streaming()
        self._target, self._goal = None, None
        span = max(height / CLIMB, SHORTEST_S)
        self._enter(Phase.CLIMBING)  # from here on a stop cuts the motors
        answer = self._command_planner(HighLevel.TAKEOFF, lambda: self._planner.takeoff(height, span, yaw=None))
        if answer is None or answer == Status.OK:
            return  # a lost answer is no refusal: `update_phase` sees whether it flies
        if answer == Status.REFUSED and self._telemetry.info & (Info.PLANNER_ACTIVE | Info.FLYING):
            return  # the reply to the first of two commands was lost
        self._enter(Phase.GROUND)
        self.trouble = f"take-off refused: {ANSWERS.get(answer, f'error {answer}')}"

    def land(self) -> None:
        """Descend at the current place, then switch the motors off."""
        if self.phase is Phase.GROUND and self._flying:
            self._enter(Phase.FLYING)
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        self._land(self._descent)

    def _land(self, speed: float) -> None:
        span = min(max(float(self._telemetry.position[2]) / speed, SHORTEST_S), LONGEST_S)
        if not math.isfinite(span):
            span = SHORTEST_S
        self._command_planner(HighLevel.LAND, lambda: self._planner.land(0.0, span, yaw=None))
        self._end_streaming()  # after the command: an idle planner without setpoints stops the motors
        self._enter(Phase.LANDING)
        self._span = span

    def stop(self) -> None:
        """Cut the motors; `send_due` repeats the command until the status confirms it.

        Not sent to a drone on the ground: an emergency stop locks it until it is switched off and on.
        """
        fresh = time.monotonic() - self._telemetry.status_time < FRESH_S
        if not self.airborne and fresh and not self._flying:
            return
        if self.phase is not Phase.STOPPING:
            self._enter(Phase.STOPPING)
        self.link.cf.supervisor.send_emergency_stop()

    # ------------------------------------------------------------------ in the air

    def send_due(self, now: float) -> None:
        """Send the packets that are due at `now` on the monotonic clock [s]."""
        if self.phase is Phase.STOPPING:
            if now - self._since > ANSWER_S:
                self.trouble = UNANSWERED
            self.link.cf.supervisor.send_emergency_stop()
        if self.phase is Phase.LANDING and now - self._since > self._span + AGAIN_S and self._flying:
            self._land(self._descent)  # a gap took the order
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        if now - max(self._commanded_at, self._since) > LOOP_SILENCE_S:
            self.trouble = "landed: no commands from the robot's loop"
            self.land()
            return
        self._stream(now)

    def keep_flying(self, now: float, link: CrazyflieLink) -> None:
        """Stream the last setpoint over a link that is still being set up: the firmware does not wait for that."""
        if self.phase is Phase.FLYING:
            self.link = link
            self._stream(now)

    def _stream(self, now: float) -> None:
        """Send the setpoint, if due."""
        target = self._target
        if self.link.busy or now - self._held_since < STEADY_S:
            return
        if target is None or now - self._sent < 1.0 / self._settings.stream_hz - 0.5 * POLL_S:
            return
        self._sent = now
        if self.phase is Phase.CLIMBING:
            self._enter(Phase.FLYING)
        x, y, z, yaw = target
        if self._settings.control == "position":
            self.link.cf.commander.send_position_setpoint(x, y, z, math.degrees(yaw))
        elif self._settings.control == "velocity":
            self._send_velocity(target)
        elif self._goal is None or math.dist(self._goal[:3], target[:3]) > MOVED or abs(self._goal[3] - yaw) > TURNED:
            far = math.dist(self._telemetry.position.tolist(), target[:3])
            span = max(PEAK * far / CRAZYFLIE.speed, SHORTEST_GO_TO_S)
            self._goal = target
            self._planner.go_to(x, y, z, yaw, span)

    def hold_after_gap(self, gap: float) -> None:
        """Give the drone to the planner on board after a gap of the radio of `gap` [s], or land it after a long one."""
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        now = time.monotonic()
        self._gaps = [at for at in self._gaps if now - at < STUTTERING_S] + [now]
        if gap > LANDING_GAP_S or len(self._gaps) > MOST_GAPS:
            many = f"{len(self._gaps)} gaps of the radio in {STUTTERING_S:g} s"
            self.trouble = f"landed: no radio for {gap:.1f} s" if gap > LANDING_GAP_S else f"landed: {many}"
            self._descent = GENTLE
            self.land()
            return
        target = self._target
        if self.phase is Phase.FLYING and target is not None and self._settings.control != "high-level":
            span = max(PEAK * math.dist(self._telemetry.position.tolist(), target[:3]) / CRAZYFLIE.speed, SHORTEST_S)
            self._planner.go_to(*target, span if math.isfinite(span) else SHORTEST_S)
            self._end_streaming()  # after the command: an idle planner without setpoints stops the motors
        self._held_since = now

    def update_phase(self, now: float) -> None:
        """Update the phase from the drone's status at `now` on the monotonic clock [s]."""
        telemetry = self._telemetry
        if now - telemetry.arrival > FRESH_S:
            return
        info, flying = telemetry.info, self._flying
        since = telemetry.status_time - self._since  # a status that waited behind others tells of an earlier phase
        if self.phase is Phase.GROUND and flying and since > STOPPING_S:
            self.trouble = "landed: it flew without an order"
            self.land()
            return
        if self.airborne and Info.LOCKED in info:
            self.trouble = "" if self.phase is Phase.STOPPING else "the drone cut its motors"
            self._enter(Phase.STOPPED)
        elif self.phase is Phase.STOPPING:
            if not flying and since > STOPPING_S:
                self.trouble = ""
                self._enter(Phase.STOPPED)
        elif self.phase is Phase.STOPPED and not flying and Info.LOCKED not in info and since > STOPPING_S:
            self._enter(Phase.GROUND)  # switched off and on
            self.trouble = ""
        elif self.phase is Phase.LANDING and not flying and since > SHORTEST_S:
            self._enter(Phase.GROUND)
        elif self.airborne and not flying and since > FLYING_FLAG_S:
            self._enter(Phase.GROUND)
            self.trouble = self.trouble or "its motors do not turn"
        elif telemetry.battery_low and self.phase in (Phase.CLIMBING, Phase.FLYING):
            self.trouble = "landed: battery low"
            self.land()

    def mark_out_of_reach(self) -> None:
        """Link lost for so long that the firmware has cut the motors, provided that setpoints were streamed."""
        if self.airborne:
            stopping = self.phase is Phase.STOPPING
            held = self._held_since > self._sent or self._settings.control == "high-level"
            alone = self.phase is Phase.CLIMBING or ((stopping or self.phase is Phase.FLYING) and held)
            self.trouble = "out of reach: may still hover by itself" if alone else "out of reach: its motors are off"
            if not (alone and stopping):  # else: the stop is sent as soon as the drone is in reach again
                self._enter(Phase.GROUND)

    def resume(self) -> bool:
        """Continue on a new link after a loss; True if the drone is in the air."""
        if self.phase is Phase.STOPPING:
            return True
        if self._flying and self.phase is not Phase.STOPPED:
            self._descent = GENTLE
            if not self.airborne:
                self._enter(Phase.FLYING)
            return True
        return False

    # ------------------------------------------------------------------ parts of the above

    @property
    def _flying(self) -> bool:
        """Whether the supervisor reports that the motors turned within the last two seconds."""
        return Info.FLYING in self._telemetry.info

    @property
    def _planner(self):  # type: ignore[no-untyped-def]  # noqa: ANN202 - cflib's own object
        return self.link.cf.high_level_commander

    def _enter(self, phase: Phase) -> None:
        self.phase, self._since = phase, time.monotonic()
        self.publish_airborne()

    def takeoff_refusal(self) -> str:
        """Reason against a take-off; empty if none."""
        telemetry = self._telemetry
        age = time.monotonic() - telemetry.status_time
        if age > FRESH_S:
            return f"no take-off: its last status is {age:.1f} s old; is its radio too full, or gone?"
        if telemetry.battery_low:
            return "no take-off: battery low"
        if Info.LOCKED in telemetry.info:
            return "locked: switch it off and on"
        if Info.CRASHED in telemetry.info or Info.TUMBLED in telemetry.info:
            return f"no take-off: {telemetry.status_text()}"
        if not telemetry.board.settled[telemetry.row]:
            return "no take-off: its position estimate has not settled"
        return ""

    def _arm(self) -> str:
        """Arm the motors if necessary, until they may turn; returns the reason of a failure, or an empty text."""
        begin, asked = time.monotonic(), -math.inf
        while Info.CAN_FLY not in self._telemetry.info:
            armed, now = Info.ARMED in self._telemetry.info, time.monotonic()
            if not self._settings.arm and not armed:
                return "not armed, and arm = false"
            if now > begin + ARMING_S:
                return "arming refused: is the drone level, its battery full enough?"
            if not armed and now > asked + REPLY_S:
                asked = now
                self.link.cf.supervisor.send_arming_request(True)
            self._pause(POLL_S)
        return ""

    def _command_planner(self, command: HighLevel, send: Callable[[], None]) -> int | None:
        """Send a high-level command until the drone replies; returns the code of the reply, or None."""
        before, _ = self.link.planner_reply(command)
        for attempt in range(TRIES):
            if self.phase is Phase.FLYING and attempt % SETPOINT_EVERY == 0:
                self._sent = -math.inf
                self._stream(time.monotonic())  # else the firmware levels out, and cuts the motors before it replies
            send()  # after the setpoint: a setpoint makes the planner forget its plan
            deadline = time.monotonic() + REPLY_S
            while time.monotonic() < deadline:
                self._pause(0.25 * POLL_S)
                count, code = self.link.planner_reply(command)
                if count > before:
                    return code
        return None

    def _end_streaming(self) -> None:
        """Announce the end of setpoints to the firmware; sent three times, because there is no reply."""
        for _ in range(3):
            self.link.cf.commander.send_notify_setpoint_stop()
            self._pause(POLL_S)

    def _send_velocity(self, target: Target) -> None:
        """Send the velocity toward a position, by the law of the firmware's own position controller."""
        telemetry, limit = self._telemetry, CRAZYFLIE.speed
        here = telemetry.position.tolist()
        if not all(map(math.isfinite, here)):
            return
        v = [CRAZYFLIE.response * (there - at) for there, at in zip(target[:3], here, strict=True)]
        v = [min(max(speed, -limit), limit) for speed in v]
        turn = CRAZYFLIE.turn_response * math.remainder(target[3] - telemetry.yaw, 2.0 * math.pi)
        self.link.cf.commander.send_velocity_world_setpoint(*v, math.degrees(turn))
