"""Flying one Crazyflie: taking off, following setpoints, landing, stopping, in the order that its firmware wants.

Take-offs and landings are the planner's on board. Between them setpoints are streamed by default: a firmware that hears
none for half a second levels out, and cuts the motors after two, so that no failure here leaves a robot in the air.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from enum import Enum
from typing import Final

from agents.body.interface import UNANSWERED
from agents.body.kinds import CRAZYFLIE
from agents.protocols.crazyflie import Settings
from agents.protocols.crtp import HighLevel, Info, Status
from bridges.crazyflie.link import Link
from bridges.crazyflie.telemetry import Telemetry

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
SHORTEST_S: Final = 1.5  # of a take-off or landing
REPLY_S: Final = 0.15  # to the answer to a high-level command; asked again after that
TRIES: Final = 12
ARMING_S: Final = 2.0
STOPPING_S: Final = 2.0  # a Crazyflie that was stopped and does not say that it is locked says so long that it flies
ANSWER_S: Final = 2.5  # an emergency stop that is not answered for so long is worth a word
POLL_S: Final = 0.02
FRESH_S: Final = 1.0  # a status older than this says nothing
LOOP_SILENCE_S: Final = 1.0  # the robot's loop must command at least this often while it flies
GRACE_S: Final = 3.0  # from a take-off to the flag that says so
MOVED: Final = 0.01  # [m] a goal that moved by less is the same to the planner
TURNED: Final = math.radians(2.0)
PEAK: Final = 35.0 / 16.0  # largest over mean speed of the planner's polynomial from rest to rest
QUICKEST_S: Final = 0.5  # of a go_to

ANSWERS: Final[dict[int | None, str]] = {Status.BUSY: "not armed, or locked", Status.REFUSED: "its planner is busy"}

Target = tuple[float, float, float, float]
Pause = Callable[[float], None]


class Phase(Enum):
    """What a Crazyflie is at."""

    GROUND = "on the ground"
    CLIMBING = "taking off"
    FLYING = "flying"
    LANDING = "landing"
    STOPPING = "told to stop, not answered yet"
    STOPPED = "stopped"


AIRBORNE: Final = (Phase.CLIMBING, Phase.FLYING, Phase.LANDING, Phase.STOPPING)


class Flight:
    """Flies one Crazyflie over whatever link there is; called by its pilot's thread only, except `aim`.

    Attributes:
        link: The connection; a new one after a loss.
        phase: What it is at.
        trouble: What went wrong last, for people; empty if nothing did.
    """

    def __init__(self, settings: Settings, telemetry: Telemetry, pause: Pause) -> None:
        """`pause` lets some seconds pass; it raises when the link is lost or something more urgent is to be done."""
        self.link: Link
        self.phase = Phase.GROUND
        self.trouble = ""
        self._settings, self._telemetry, self._pause = settings, telemetry, pause
        self._target: Target | None = None
        self._aimed = math.inf
        self._since = -math.inf
        self._sent = -math.inf
        self._goal: Target | None = None

    @property
    def airborne(self) -> bool:
        """Whether its motors are on, as far as is known."""
        return self.phase in AIRBORNE

    def aim(self, now: float, target: Target | None) -> None:
        """What the robot's loop wants at `now` on the monotonic clock [s]; None: nothing new. From any thread."""
        self._aimed = now
        if target is not None:
            self._target = target

    def show(self) -> None:
        """Puts on the board whether it is airborne."""
        self._telemetry.board.airborne[self._telemetry.row] = self.airborne

    # ------------------------------------------------------------------ orders

    def takeoff(self, height: float) -> None:
        """Climbs to `height` [m] over where it stands; if it cannot, `trouble` says why."""
        if self.airborne:
            return
        self.trouble = self._obstacle() or self._arm()
        if self.trouble:
            return
        self._release()
        self._target, self._goal = None, None
        span = max(height / CLIMB, SHORTEST_S)
        self._enter(Phase.CLIMBING)  # from here on a stop means motors off
        answer = self._plan(HighLevel.TAKEOFF, lambda: self._planner.takeoff(height, span, yaw=None))
        if answer == Status.OK:
            return
        if answer == Status.REFUSED and Info.PLANNER_ACTIVE in self._telemetry.info:
            return  # the answer to the first of two was lost
        self._enter(Phase.GROUND)
        self.trouble = f"it refused to take off: {ANSWERS.get(answer, 'no answer')}"

    def land(self) -> None:
        """Descends where it is, and switches off."""
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        span = max(float(self._telemetry.position[2]) / CLIMB, SHORTEST_S)
        if not math.isfinite(span):
            span = SHORTEST_S
        self._plan(HighLevel.LAND, lambda: self._planner.land(0.0, span, yaw=None))
        self._release()  # after the command: before it, the planner would have nothing to follow, and the motors stop
        self._enter(Phase.LANDING)

    def stop(self) -> None:
        """Motors off; `guide` says it again until it is answered.

        One that stands is left alone: an emergency stop locks it until it is switched off and on.
        """
        telemetry = self._telemetry
        fresh = time.monotonic() - telemetry.told < FRESH_S
        if not self.airborne and fresh and Info.FLYING not in telemetry.info:
            return
        if self.phase is not Phase.STOPPING:
            self._enter(Phase.STOPPING)
        self.link.cf.supervisor.send_emergency_stop()

    # ------------------------------------------------------------------ in the air

    def guide(self, now: float) -> None:
        """Sends what is due at `now` on the monotonic clock [s]."""
        if self.phase is Phase.STOPPING:
            if now - self._since > ANSWER_S:
                self.trouble = UNANSWERED
            self.link.cf.supervisor.send_emergency_stop()
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        if now - max(self._aimed, self._since) > LOOP_SILENCE_S:
            self.trouble = "landed it: nobody commanded it any more"
            self.land()
            return
        self._stream(now)

    def _stream(self, now: float) -> None:
        """Sends the setpoint, if one is due."""
        target = self._target
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
            span = max(PEAK * far / CRAZYFLIE.speed, QUICKEST_S)
            self._goal = target
            self._planner.go_to(x, y, z, yaw, span)

    def watch(self, now: float) -> None:
        """Takes in what the Crazyflie says of itself at `now` on the monotonic clock [s]."""
        telemetry = self._telemetry
        if now - telemetry.told > FRESH_S:
            return
        info, flying = telemetry.info, Info.FLYING in telemetry.info
        since = now - self._since
        if self.airborne and Info.LOCKED in info:
            self.trouble = "" if self.phase is Phase.STOPPING else "it cut its motors"
            self._enter(Phase.STOPPED)
        elif self.phase is Phase.STOPPING:
            if not flying and since > STOPPING_S:
                self.trouble = ""
                self._enter(Phase.STOPPED)
        elif self.phase is Phase.STOPPED and not flying and Info.LOCKED not in info and since > STOPPING_S:
            self._enter(Phase.GROUND)  # it was switched off and on
            self.trouble = ""
        elif self.phase is Phase.LANDING and not flying and since > SHORTEST_S:
            self._enter(Phase.GROUND)
        elif self.airborne and not flying and since > GRACE_S:
            self._enter(Phase.GROUND)
            self.trouble = "its motors stopped"
        elif telemetry.low and self.phase in (Phase.CLIMBING, Phase.FLYING):
            self.trouble = "landed it: battery low"
            self.land()

    def doubt(self) -> None:
        """The link has been gone for so long that the firmware has cut the motors, if setpoints were streamed."""
        if self.airborne:
            stopping = self.phase is Phase.STOPPING
            alone = (stopping or self.phase is Phase.FLYING) and self._settings.control == "high-level"
            self.trouble = (
                "out of reach: it may still hover, by itself" if alone else "out of reach: its motors are off"
            )
            if not (alone and stopping):  # it is stopped as soon as it is in reach again
                self._enter(Phase.GROUND)

    def resume(self) -> bool:
        """A new link after a loss; True if it is found in the air."""
        if self.phase is Phase.STOPPING:
            return True
        if Info.FLYING in self._telemetry.info and self.phase is not Phase.STOPPED:
            if not self.airborne:
                self._enter(Phase.FLYING)
            return True
        return False

    # ------------------------------------------------------------------ how

    @property
    def _planner(self):  # type: ignore[no-untyped-def]  # noqa: ANN202 - cflib's own object
        return self.link.cf.high_level_commander

    def _enter(self, phase: Phase) -> None:
        self.phase, self._since = phase, time.monotonic()
        self.show()

    def _obstacle(self) -> str:
        """Why it cannot take off; empty if it can."""
        telemetry = self._telemetry
        if time.monotonic() - telemetry.told > FRESH_S:
            return "it has not said how it is"
        if telemetry.low:
            return "it does not take off: battery low"
        if Info.LOCKED in telemetry.info:
            return "it is locked: switch it off and on"
        if not telemetry.board.placed[telemetry.row]:
            return "it does not take off: it does not know where it is"
        return ""

    def _arm(self) -> str:
        """Arms it if it is not; why it could not, or empty."""
        deadline = time.monotonic() + ARMING_S
        while Info.ARMED not in self._telemetry.info:
            if not self._settings.arm:
                return "it is not armed, and arm = false"
            if time.monotonic() > deadline:
                return "it refuses to be armed: is it level, its battery full enough?"
            self.link.cf.supervisor.send_arming_request(True)
            self._pause(5.0 * POLL_S)
        return ""

    def _plan(self, command: HighLevel, send: Callable[[], None]) -> int | None:
        """Sends a high-level command until it is answered; the answer, or None."""
        before, _ = self.link.reply(command)
        for _ in range(TRIES):
            send()
            deadline = time.monotonic() + REPLY_S
            while time.monotonic() < deadline:
                self._pause(0.25 * POLL_S)
                if self.phase is Phase.FLYING:  # or the firmware cuts the motors while a landing is not answered
                    self._stream(time.monotonic())
                count, code = self.link.reply(command)
                if count > before:
                    return code
        return None

    def _release(self) -> None:
        """Says that no more setpoints come. It is never answered, so it is said thrice."""
        for _ in range(3):
            self.link.cf.commander.send_notify_setpoint_stop()
            self._pause(POLL_S)

    def _send_velocity(self, target: Target) -> None:
        """The velocity that leads to a place, by the law of the firmware's own position controller."""
        telemetry, limit = self._telemetry, CRAZYFLIE.speed
        here = telemetry.position.tolist()
        if not all(map(math.isfinite, here)):
            return
        v = [CRAZYFLIE.response * (there - at) for there, at in zip(target[:3], here, strict=True)]
        v = [min(max(speed, -limit), limit) for speed in v]
        turn = CRAZYFLIE.turn_response * math.remainder(target[3] - telemetry.yaw, 2.0 * math.pi)
        self.link.cf.commander.send_velocity_world_setpoint(*v, math.degrees(turn))
