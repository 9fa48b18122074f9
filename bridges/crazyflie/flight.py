"""Flight phases of one Crazyflie: take-off, setpoints, landing and stop, in the order that the firmware requires.

Take-off and setpoints are trajectories that end on the floor (`trajectory`): no failure here leaves a robot in the air,
and none cuts its motors there. The order to land replaces them by the firmware's own landing, which stops the motors.

Flags of the supervisor, not answers to commands, tell whether a drone flies: answers may be lost, or wait behind logs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from enum import Enum
from typing import Final

from agents.body.interface import UNANSWERED, UNANSWERED_S
from agents.clock import uptime
from agents.ticks import POLL_S
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.link import CrazyflieLink
from bridges.crazyflie.protocol.addresses import SETPOINT_PACKETS, CrazyflieSettings, Outside
from bridges.crazyflie.protocol.crtp import HighLevel, Info, LogStatus
from bridges.crazyflie.telemetry import Telemetry
from bridges.crazyflie.trajectory import HOLD_S, SINK, STOP_S, Target, stop_descent_s

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs
DESCENT: Final = 0.22  # [m/s] mean speed of landings: never 0.5 m/s
UNKNOWN: Final = 3.0  # [m] height from which a drone that has reported none is landed
FLOOR: Final = -0.1  # [m] height at which they end: the motors stop there, and the drone lags behind
# without positions from outside, where the estimate of the height is wrong by half the error of the accelerometer times
# the square of the time: quick, and deep enough to end on the floor
BLIND_DESCENT: Final = 0.45  # [m/s]
BLIND_FLOOR: Final = -1.0  # [m]
EXTERNAL_AGE_S: Final = CRAZYFLIE.late_s  # older positions from outside make the estimator ring: they are not passed on
# with positions from outside a landing is led down: when the radio is lost on the way, the descent on board goes on
LED: Final = 0.3  # [m/s]
LED_TO: Final = 0.3  # [m] height from which the planner's own landing is too short to become wrong
BLIND_S: Final = 0.5  # [s] time without a young position from outside after which a drone is blind
SHORTEST_S: Final = 1.5  # duration of a take-off or landing
UPLOAD_S: Final = 3.0  # limit for writing a climb, part by part
REPLY_S: Final = 0.15  # deadline of the reply to a high-level command; then the command is repeated
TRIES: Final = 12
ARMING_S: Final = 4.0  # motors that are checked one by one take seconds
STOPPING_S: Final = 2.0  # time after a stop for which a Crazyflie that does not report "locked" still reports "flying"
FRESH_S: Final = 1.0  # an older status is ignored
LOOP_SILENCE_S: Final = 1.0  # [s] longest pause of the robot's loop between commands in flight
FLYING_FLAG_S: Final = 3.0  # [s] time from a take-off to the flag "flying" in the status
LANDING_GAP_S: Final = 0.8  # [s] gap after which the drone is landed: it has flown without control
SLOWEST_HZ: Final = 2.5  # setpoints over a radio that has become slow
REFRESH_S: Final = 0.25  # a setpoint that does not change is sent again after this
STRAIGHT: Final = 0.1  # [rad] a smaller yaw is turned to 0 on the way up: two packets instead of seventeen
SAME: Final = 0.5e-3  # [m], [rad] a smaller change of a setpoint is none: positions are sent in millimetres
PERIODS: Final = 2.5  # periods of setpoints for which, and for `HOLD_S`, the last one is held
MARGIN_S: Final = 2.0  # [s] time from the end of its trajectory at the floor until an unreachable drone is down
HOLD_AGE_S: Final = 0.3  # [s] age of the last pose from which new setpoints are ignored
AGAIN_S: Final = 3.0  # a landing that takes longer than planned by this is ordered again
RELEASE_S: Final = 1.0  # period at which setpoints of another client are ended; after 2 s without new ones they lock it
LAND_S: Final = 0.5  # period at which a landing is ordered again: setpoints of another client end it unnoticed,
NEAR_S: Final = 0.3  # [s] least distance to its end: after it the motors would start again;
LOW: Final = 0.2  # [m] height from which the drone flies, or stands on a table:
LATE_LANDINGS: Final = 3  # number of attempts
UNSTARTED_S: Final = 1.0  # a drone that has descended by itself for longer, because no setpoint was started, is landed
STARTS: Final = 8  # trajectories that may be on board
TURNED: Final = 0.35  # [rad] largest difference of the yaw on board from that of the external positions
MUTED: Final = 2  # landings that another client has ended before the note says so
OUT_OF_REACH: Final = "out of reach: "
FALLEN: Final = "landed without positions: it may have fallen"

ANSWERS: Final[dict[int, str]] = {LogStatus.BUSY: "not armed, or locked", LogStatus.REFUSED: "its planner is busy"}

Pause = Callable[[float], None]


class FlightPhase(Enum):
    """Flight phase of a Crazyflie; the value is its text for users."""

    GROUND = "on the ground"
    CLIMBING = "taking off"
    FLYING = "flying"
    LANDING = "landing"
    STOPPING = "stop sent, not confirmed yet"
    STOPPED = "stopped"


AIRBORNE: Final = (FlightPhase.CLIMBING, FlightPhase.FLYING, FlightPhase.LANDING, FlightPhase.STOPPING)


class FlightControl:
    """Flight control of one Crazyflie over its current link; called by its pilot's thread only, except `set_target`."""

    def __init__(self, settings: CrazyflieSettings, telemetry: Telemetry, pause: Pause) -> None:
        """`pause` waits for some seconds; it raises when the link is lost or a stop is ordered."""
        self.link: CrazyflieLink  # current connection; a new one after a loss
        self.phase = FlightPhase.GROUND
        self.trouble = ""  # last fault, for users; empty if none
        self._settings, self._telemetry, self._pause = settings, telemetry, pause
        self._target: Target | None = None
        self._commanded_at = math.inf
        self.phase_since = -math.inf
        self._due = -math.inf  # next setpoint [s]
        self._begun = math.inf  # begin of the setpoint that is being sent [s]
        self._sent: Target | None = None  # last setpoint,
        self._sent_at = -math.inf  # [s]
        self._released_at = -math.inf  # last end of other clients' setpoints [s]
        self._down_at = -math.inf  # time at which the drone is down, if nothing more reaches it [s]
        self._top: Target | None = None  # end of the climb, held until the first setpoint
        self._external = (math.nan, math.nan)  # height [m] and yaw [rad] that were measured from outside
        self._external_at = -math.inf  # arrival of the newest [s]
        self._located_at = -math.inf  # arrival of the newest that was young [s]
        self.outside = isinstance(settings.positioning, Outside)  # positions from outside correct its estimate
        self._blind_landing = False  # the landing began without positions
        self._ended_landings = 0  # count of those that another client has ended
        self._led = False  # the landing is led down
        self._led_from: tuple[Target, float] | None = None  # its begin: place, and time [s]; None: not known yet
        self._refused = False  # `trouble` is a reason against a take-off
        self._ordered = SHORTEST_S, False  # duration of the last landing that was ordered [s], without positions
        self._late_landings = 0  # count of those that were ordered and begun after their end
        self._land_replies = 0  # replies of the planner to orders to land
        self._armed_at = -math.inf  # last order to arm [s]
        self._disarm_at = math.inf  # next order to disarm [s]; infinity: none
        # heights [m] to which trajectories lead: of the last that is confirmed, and of those that are not
        self._on_board: deque[float] = deque(maxlen=STARTS)
        self._start_replies = 0  # replies of the planner to starts
        self._stream_hz = settings.stream_hz
        self.span_s = 0.0  # duration of the take-off or landing [s]

    @property
    def airborne(self) -> bool:
        """Whether the motors are on, as far as known."""
        return self.phase in AIRBORNE

    @property
    def at_rest(self) -> bool:
        """Whether the motors are off and nothing that was armed for a take-off is still to be disarmed."""
        return not self.airborne and self._disarm_at == math.inf

    def set_target(self, now: float, target: Target | None) -> None:
        """Store the setpoint of the robot's loop at `now` [s, `uptime`]; None keeps the last one. From any thread."""
        self._commanded_at = now
        if target is not None and self._telemetry.pose_age < HOLD_AGE_S:
            self._target = target

    def note_external(self, height: float, yaw: float, age: float) -> None:
        """Store the height [m] and yaw [rad], or NaN, as measured from outside `age` [s] ago. From any thread."""
        self._external, self._external_at = (height, yaw), uptime()
        if age <= EXTERNAL_AGE_S or self._located_at == -math.inf:  # the first have waited while it connected
            self._located_at = self._external_at

    @property
    def _blind(self) -> bool:
        """Whether the estimate drifts, because no young position comes from outside."""
        return self.outside and uptime() - self._located_at > BLIND_S

    @property
    def late(self) -> str:
        """Fault of positions from outside that come too late, for users; empty if none."""
        if not self._blind or uptime() - self._external_at > BLIND_S:
            return ""
        return f"its positions from outside are older than {EXTERNAL_AGE_S:g} s, and are not used"

    @property
    def muted(self) -> str:
        """Fault of a landing that another client ends again and again, for users; empty if none."""
        if self.phase is not FlightPhase.LANDING or self._ended_landings < MUTED:
            return ""
        return "its landing is ended by setpoints of another client, and ordered again: end that client"

    @property
    def turned(self) -> str:
        """Fault of a drone that is turned otherwise than its estimator believes, for users; empty if none."""
        yaw = self._telemetry.pose[6] - self._external[1]
        wrong = abs(math.remainder(yaw, math.tau)) if math.isfinite(yaw) else 0.0
        if wrong < TURNED:
            return ""
        return f"its own yaw is {math.degrees(wrong):.0f}° beside that of its positions: switch it off and on"

    @property
    def landing_s(self) -> float:
        """Duration of a landing from here, with one that is ordered again [s]."""
        return max(self.span_s, self._highest / DESCENT) + AGAIN_S + SHORTEST_S

    def publish_airborne(self) -> None:
        """Write `airborne` to the telemetry."""
        self._telemetry.airborne = self.airborne

    @property
    def hold_s(self) -> float:
        """Time for which a setpoint is held before the descent [s]."""
        return max(HOLD_S, PERIODS / self._stream_hz)

    def scale_setpoints(self, share: float) -> None:
        """Set the rate of setpoints to a share of that chosen; not below `SLOWEST_HZ`, unless that was chosen."""
        chosen = self._settings.stream_hz
        self._stream_hz = min(max(share * chosen, SLOWEST_HZ), chosen)

    # ------------------------------------------------------------------ orders

    def takeoff(self, height: float) -> None:
        """Climb to `height` [m] above the ground here; on refusal, `trouble` gives the reason."""
        if self.airborne:
            return
        x, y, z, *_, yaw = self._telemetry.pose
        place = x, y, z, yaw if abs(yaw) > STRAIGHT else 0.0
        span = max(height / CLIMB, SHORTEST_S)
        self.trouble, self._disarm_at = self.takeoff_refusal(), math.inf
        self._refused = bool(self.trouble)
        trajectory = None if self.trouble else self._write_climb(place, (height, span))
        if trajectory is None:
            return
        self._disarm_at = -math.inf  # time of disarming, unless it takes off
        self.trouble = self._arm()
        if self.trouble:
            return
        for _ in range(3):  # sent without answer: low-level setpoints of another program would mute the planner
            self._release()
            self._pause(POLL_S)
        self._disarm_at = math.inf
        self._target, self._top = None, (x, y, height, place[3])
        self._sent, self.span_s = None, span
        self._on_board.clear()
        self._on_board.append(height)
        self.enter(FlightPhase.CLIMBING)  # a stop cuts the motors from here on
        latest = self.phase_since + TRIES * REPLY_S  # [s] last start, if it still arrives
        self._plan_end(latest + span, height, span)
        trajectories = self.link.trajectories
        answer = self._command_planner(
            trajectories.start_command, lambda: trajectories.start(trajectory), Info.PLANNER_ACTIVE
        )
        replies, _ = self.link.planner_reply(trajectories.start_command)
        self._start_replies = replies + (answer is None)  # an answer that is not here yet may come
        if answer is None or answer == LogStatus.OK:
            return  # a lost answer is no refusal: `update_phase` sees whether it flies
        self.enter(FlightPhase.GROUND)
        self._disarm_at = -math.inf
        self.trouble = f"take-off refused: {ANSWERS.get(answer, f'error {answer}')}"

    def land(self) -> None:
        """Descend at the current place, then switch the motors off; disarm on the ground."""
        if self.phase is FlightPhase.GROUND and self._flying:
            self.enter(FlightPhase.FLYING)
        if self.phase in (FlightPhase.CLIMBING, FlightPhase.FLYING):
            if self.outside and not self._blind:
                self.enter(FlightPhase.LANDING)
                self.span_s, self._led = self._highest / LED + SHORTEST_S, True
            else:
                self._land()
        elif self.phase is FlightPhase.GROUND:
            self._disarm_at = -math.inf

    def _lead_down(self, now: float) -> None:
        """Lead a landing down to `LED_TO` at `now` [s]; the planner lands it from there, or where it is blind."""
        telemetry, (place, begin) = self._telemetry, self._led_from or (None, now)
        if self.link.busy:
            return
        if place is None and telemetry.pose_age < HOLD_AGE_S:
            x, y, z, *_, yaw = telemetry.pose
            self._led_from = place, begin = (x, y, z, yaw), now
        unconfirmed = now - max(self._sent_at, self.phase_since) > self.hold_s
        height = LED_TO if place is None else place[2] - LED * (now - begin)
        if self._blind or unconfirmed or (place is not None and not height > LED_TO):
            self._land()
        elif place is not None and now >= self._due:
            self._send_target((*place[:2], height, place[3]), now)

    def _land(self) -> None:
        self._command_planner(HighLevel.LAND, self._order_landing)
        self._late_landings = self._ended_landings = 0
        self._begin_landing()

    def _order_landing(self) -> None:
        """End other clients' setpoints, and order the landing.

        In this order: one that comes in between mutes the landing, else it would end it, and the motors stopped.
        """
        floor, descent = (BLIND_FLOOR, BLIND_DESCENT) if self._blind else (FLOOR, DESCENT)
        span = max((self._highest - floor) / descent, SHORTEST_S)
        self._ordered = span, self._blind
        self._release()
        self.link.cf.high_level_commander.land(floor, span, yaw=None)

    def _begin_landing(self) -> None:
        self.enter(FlightPhase.LANDING)
        self.span_s, self._blind_landing = self._ordered
        self._down_at = self.phase_since + self.span_s + MARGIN_S
        self._land_replies, _ = self.link.planner_reply(HighLevel.LAND)

    def _repeat_landing(self, now: float) -> None:
        """Order a landing again that a gap or another client has ended; a planner that lands refuses the order."""
        telemetry = self._telemetry
        near = now - self.phase_since > self.span_s - NEAR_S
        replies, answer = self.link.planner_reply(HighLevel.LAND)
        if replies > self._land_replies and answer == LogStatus.OK:
            self._late_landings += near
            self._ended_landings += not near
            self._begin_landing()
        elif replies > self._land_replies:
            self._land_replies, self._ended_landings = replies, 0
        ended = telemetry.pose_time - self.phase_since > self.span_s  # what waits in queues tells of before
        # the height of a blind drone says nothing
        high = ended and not self._blind and telemetry.pose[2] > LOW and self._late_landings < LATE_LANDINGS
        if telemetry.status_time - self.phase_since > self.span_s + AGAIN_S:
            self._land()
        elif (high or not near) and not self.link.busy and now - self._released_at > LAND_S:
            self._order_landing()

    @property
    def _highest(self) -> float:
        """Largest height [m] at which the drone can be: as measured, or where trajectories lead that may be on board.

        In a gap it follows them to their ends, and its estimate drifts.
        """
        heights = (self._telemetry.pose[2], self._external[0], *self._on_board)
        return max(filter(math.isfinite, heights), default=UNKNOWN)

    def _confirm_starts(self) -> None:
        """Forget trajectories that others have replaced on board, as the planner has answered."""
        replies, _ = self.link.planner_reply(self.link.trajectories.start_command)
        for _ in range(min(replies - self._start_replies, len(self._on_board) - 1)):
            self._on_board.popleft()
        self._start_replies = replies

    def stop(self) -> None:
        """Cut the motors; `send_due` repeats the command until the status confirms it.

        Not sent to a drone on the ground: an emergency stop locks it until it is switched off and on.
        """
        fresh = uptime() - self._telemetry.status_time < FRESH_S
        if not self.airborne and fresh and not self._flying:
            self._disarm_at = -math.inf
            return
        if self.phase is not FlightPhase.STOPPING:
            self.enter(FlightPhase.STOPPING)
        self.link.cf.supervisor.send_emergency_stop()

    # ------------------------------------------------------------------ in the air

    def send_due(self, now: float) -> None:
        """Send the packets that are due at `now` on the clock `uptime` [s]."""
        if self.phase is FlightPhase.STOPPING:
            if now - self.phase_since > UNANSWERED_S:
                self.trouble = UNANSWERED
            self.link.cf.supervisor.send_emergency_stop()
        if now > self._disarm_at:
            self._disarm()
        if self.phase is FlightPhase.LANDING and self._led:
            self._lead_down(now)
        elif self.phase is FlightPhase.LANDING and self._flying:
            self._repeat_landing(now)
        if self.phase not in (FlightPhase.CLIMBING, FlightPhase.FLYING):
            return
        if self.late:
            self.trouble = f"landed: {self.late}"
            self.land()
            return
        self._confirm_starts()
        begun = self.phase_since + (self.span_s if self.phase is FlightPhase.CLIMBING else 0.0)
        if now - max(self._sent_at, begun) > self.hold_s + UNSTARTED_S and not self.link.busy:
            self.trouble = "landed: its setpoints are not confirmed"
            self.land()
            return
        if now - max(self._commanded_at, self.phase_since) > LOOP_SILENCE_S:
            self.trouble = "landed: no commands from the robot's loop"
            self.land()
            return
        self.stream(now)

    def stream(self, now: float) -> None:
        """Send the setpoint, if due; while the drone has none, the end of its climb."""
        target = self._target
        if target is None and now - self.phase_since > self.span_s:
            target = self._top
        if target is None or now < self._due or self.link.busy:
            return
        if uptime() - self._commanded_at > LOOP_SILENCE_S:  # the process stood still until a moment ago
            return
        if self._target is not None and self.phase is FlightPhase.CLIMBING:
            self.enter(FlightPhase.FLYING)
        if _same(target, self._sent) and now - self._sent_at < REFRESH_S:
            return
        self._send_target(target, now)

    def _send_target(self, target: Target, now: float) -> None:
        """Send the next part of a setpoint."""
        self._begun = min(self._begun, now)
        packets = self.link.trajectories.hold(target, self.hold_s, self._release_others)
        if packets == 0:
            return
        self._sent, self._sent_at = target, now
        self._on_board.append(target[2])
        self._due = self._begun + packets / (SETPOINT_PACKETS * self._stream_hz) - 0.5 * POLL_S
        self._begun = math.inf
        self._plan_end(now, target[2])

    def _plan_end(self, since: float, height: float, climb: float = 0.0) -> None:
        """Note when a trajectory from a height [m] since a time [s] has reached the floor, or stopped the motors.

        `climb`: time since the last position until then [s].
        """
        down = stop_descent_s(height, climb) + STOP_S if self.outside else self.hold_s + max(height, 0.0) / SINK
        self._down_at = since + down + MARGIN_S

    def _release(self) -> None:
        """End the setpoints of other clients, which mute the planner: 2 s after the last one the drone would lock."""
        self._released_at = uptime()
        self.link.cf.commander.send_notify_setpoint_stop()

    def _release_others(self) -> None:
        """End the setpoints of other clients in flight, at once where the drone reports that it follows no plan."""
        telemetry = self._telemetry
        stopped = telemetry.reports_plans and Info.PLANNER_ACTIVE not in telemetry.info
        if stopped or uptime() - self._released_at > RELEASE_S:
            self._release()

    def land_after_gap(self, gap: float) -> None:
        """Land after `gap` [s] in which nothing was received, or the process stood still, if it was long."""
        if gap > LANDING_GAP_S and self.phase in (FlightPhase.CLIMBING, FlightPhase.FLYING):
            self.trouble = f"landed: nothing received for {gap:.1f} s"
            self.land()

    def update_phase(self, now: float) -> None:
        """Update the phase from the drone's status at `now` on the clock `uptime` [s]."""
        telemetry = self._telemetry
        if now - telemetry.arrival > FRESH_S:
            return
        info, flying = telemetry.info, self._flying
        since = telemetry.status_time - self.phase_since  # a status that waited behind others tells of an earlier phase
        if self.phase is FlightPhase.GROUND and flying and since > STOPPING_S:
            self.trouble = "landed: it flew without an order"
            self.land()
            return
        if self.airborne and Info.LOCKED in info:
            self.trouble = "" if self.phase is FlightPhase.STOPPING else "the drone cut its motors"
            self.enter(FlightPhase.STOPPED)
        elif self.phase is FlightPhase.STOPPING:
            if not flying and since > STOPPING_S:
                self.trouble = ""
                self.enter(FlightPhase.STOPPED)
        elif self.phase is FlightPhase.STOPPED and not flying and Info.LOCKED not in info and since > STOPPING_S:
            self.enter(FlightPhase.GROUND)  # switched off and on
            self.trouble = ""
        elif self.phase is FlightPhase.LANDING and not flying and since > SHORTEST_S:
            self.enter(FlightPhase.GROUND)
            if self._blind_landing and self._blind:
                self.trouble = "; ".join(filter(None, (self.trouble, FALLEN)))
        elif self.airborne and not flying and since > FLYING_FLAG_S:
            self.enter(FlightPhase.GROUND)
            self._disarm_at = -math.inf
            self.trouble = self.trouble or "its motors do not turn"
        elif telemetry.battery_low and self.phase in (FlightPhase.CLIMBING, FlightPhase.FLYING):
            self.trouble = "landed: battery low"
            self.land()
        elif self._refused and not self.takeoff_refusal():
            self._refused, self.trouble = False, ""

    def mark_out_of_reach(self) -> bool:
        """Note a lost link; True if what lies on board has ended on the floor.

        The drone counts as flying until it is seen: its motors may be on.
        """
        down = uptime() > self._down_at
        if self.airborne and self.phase is not FlightPhase.STOPPING:  # a stop is sent when the drone is in reach again
            ended = "approach it only when its motors stand" if self.outside else "motors may be on: switch it off"
            self.trouble = OUT_OF_REACH + (ended if down else "it lands by itself")
        return down

    def resume(self) -> bool:
        """Continue on a new link after a loss; True if the drone is in the air."""
        if self.trouble.startswith(OUT_OF_REACH):
            self.trouble = ""
        if self.phase is FlightPhase.STOPPING:
            return True
        if self._flying and self.phase is not FlightPhase.STOPPED:
            if not self.airborne:
                self.enter(FlightPhase.FLYING)
            self._start_replies = 0
            return True
        if self.airborne:
            self.enter(FlightPhase.GROUND)
        return False

    # ------------------------------------------------------------------ parts of the above

    @property
    def _flying(self) -> bool:
        """Whether the supervisor reports that the motors turned within the last two seconds."""
        return Info.FLYING in self._telemetry.info

    def enter(self, phase: FlightPhase) -> None:
        self.phase, self.phase_since = phase, uptime()
        self._refused = False
        self._led, self._led_from = False, None
        self.publish_airborne()

    def takeoff_refusal(self) -> str:
        """Reason against a take-off; empty if none."""
        telemetry = self._telemetry
        age = uptime() - telemetry.status_time
        if age > FRESH_S:
            return f"no take-off: its last status is {age:.1f} s old; is its radio too full, or gone?"
        if telemetry.battery_low:
            return "no take-off: battery low"
        if Info.LOCKED in telemetry.info:
            return "locked: switch it off and on"
        if Info.CRASHED in telemetry.info or Info.TUMBLED in telemetry.info:
            return f"no take-off: {telemetry.status_text()}"
        if not telemetry.settled:
            return "no take-off: its position estimate has not settled"
        fault = self.turned or self.late or ("no position comes from outside" if self._blind else "")
        return f"no take-off: {fault}" if fault else ""

    def _write_climb(self, place: Target, climb: tuple[float, float]) -> int | None:
        """Write the climb; returns its number, or None, with `trouble`."""
        begin = uptime()
        while (number := self.link.trajectories.write_climb(place, climb, self.hold_s)) is None:
            if uptime() > begin + UPLOAD_S:
                self.trouble = "no take-off: its trajectory is not confirmed; is its radio too full, or gone?"
                break
            self._pause(0.25 * POLL_S)
        return number

    def _arm(self) -> str:
        """Arm the motors if necessary, until they may turn; returns the reason of a failure, or an empty text."""
        begin, asked = uptime(), -math.inf
        while Info.CAN_FLY not in self._telemetry.info:
            armed, now = Info.ARMED in self._telemetry.info, uptime()
            if not self._settings.arm and not armed:
                return "not armed, and arm = false"
            if now > begin + ARMING_S:
                return "arming refused: is the drone level, its battery full enough?"
            if not armed and now > asked + REPLY_S:
                asked = self._armed_at = now
                self.link.cf.supervisor.send_arming_request(True)
            self._pause(POLL_S)
        return ""

    def _disarm(self) -> None:
        """Disarm a drone on the ground that was armed for a take-off; repeated until its status confirms it."""
        now, info = uptime(), self._telemetry.info
        armed = Info.ARMED in info and Info.AUTO_ARM not in info and self._settings.arm
        asked = self._armed_at > -math.inf and now - self._armed_at < FRESH_S  # its status may not show it yet
        self._disarm_at = math.inf
        if not self.airborne and not self._flying and (armed or asked):
            self._disarm_at = now + REPLY_S
            self.link.cf.supervisor.send_arming_request(False)

    def _command_planner(self, command: HighLevel, send: Callable[[], object], flag: int = 0) -> int | None:
        """Send a high-level command until the drone replies; returns the code of the reply, or None.

        `flag`: of the status, which stands for a reply.
        """
        before, _ = self.link.planner_reply(command)
        begin = uptime()
        for _ in range(TRIES):
            send()
            deadline = uptime() + REPLY_S
            while uptime() < deadline:
                self._pause(0.25 * POLL_S)
                count, code = self.link.planner_reply(command)
                if count > before:
                    return code
                if self._telemetry.info & flag and self._telemetry.status_time > begin:
                    return None
        return None


def _same(target: Target, sent: Target | None) -> bool:
    return sent is not None and all(abs(new - old) <= SAME for new, old in zip(target, sent, strict=True))
