"""Thread of one Crazyflie: connects, sets up, executes orders, streams setpoints, supervises, and reconnects."""

from __future__ import annotations

import threading
import time
from math import cos, inf, isfinite, nan, sin
from typing import Final

from agents.body.interface import BodyError
from agents.clock import uptime
from agents.ticks import Ticks
from agents.vectors import Vector, distance
from bridges.crazyflie.flight import (
    BLIND_S,
    EXTERNAL_AGE_S,
    HOLD_AGE_S,
    LANDING_GAP_S,
    FlightControl,
    FlightPhase,
)
from bridges.crazyflie.link import CrazyflieLink, LinkError, SilentError
from bridges.crazyflie.positioning import Convergence, configure
from bridges.crazyflie.protocol.addresses import CrazyflieSettings, Outside
from bridges.crazyflie.protocol.crtp import Info
from bridges.crazyflie.telemetry import Telemetry
from bridges.crazyflie.trajectory import Target

NO_ANSWER_S: Final = 2.4  # time without any answer after which no Crazyflie is there
RADIO_LOST_S: Final = 3.0  # time without an answered poll after which the link is lost, and a new one is opened
LOST_S: Final = 1.0  # likewise without a packet over UDP or USB
LOGS_S: Final = 1.0  # gap after which the firmware has removed its log blocks
LOGLESS_S: Final = 0.5  # time without a log packet over a working link after which the log blocks are created again
STATUS_S: Final = 2.0  # deadline of the first status
RETRY_S: Final = 0.5
QUEUE_S: Final = 0.5  # poses that wait for longer, and not only for a moment, are too many: the rate of logs is halved
LATE_S: Final = 1.0
CALM_S: Final = 5.0  # time without a queue on the ground after which the rates are those chosen again
LEAST_SHARE: Final = 0.1
SLOWING_S: Final = 2.0  # more before that is done again: a queue drains meanwhile
LOOP_HZ: Final = 20.0  # least rate, for gaps and phases, however few setpoints are streamed
FAR: Final = 0.5  # [m] an estimate farther from the first external position after a gap is reset there
LANDING_S: Final = 12.0  # least time that `close` waits for a landing
JOIN_S: Final = 5.0

IN_THE_AIR: Final = "connected again, in the air"
# on the floor without radio, motors with the least thrust of the firmware (20,000 of 65,535) carry half of the weight
SAFE_PARAMETERS: Final = {"posCtlPid.thrustMin": 5000.0}

TAKEOFF_EXPIRY_S: Final = 2.0  # time after which a take-off that could not begin is dropped

Order = tuple[str, float, float]  # "takeoff", "land" or "stop"; height of a take-off [m]; time of the order [s]


class OrderReplaced(RuntimeError):
    """A stop has replaced the current order, or a standstill of the process has made it old."""


class CrazyfliePilot:
    """Thread and state of one drone."""

    def __init__(
        self,
        name: str,
        address: str,
        settings: CrazyflieSettings,
        telemetry: Telemetry,
        *,
        place: tuple[Vector, float],
        turn: threading.Lock,
    ) -> None:
        """`place`: start position [m] and yaw [rad]; `turn`: held while a drone of the radio connects."""
        self.opened = threading.Event()  # connected and set up once; position settled, unless it comes from outside
        self.failure: BodyError | None = None  # reason why the first connection failed
        self._name, self._address, self._settings, self._telemetry = name, address, settings, telemetry
        self._start_pose, self._turn = place, turn
        self._flight = FlightControl(settings, telemetry, self._pause)
        self.link: CrazyflieLink | None = None
        self._connection_note = "connecting"
        self._order: Order | None = None
        self._executing = ""  # order
        self._end_by = inf  # the thread ends then, even if the drone flies [s, `uptime`]
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._ending = threading.Event()
        self._external_pose: tuple[float, Vector, float] | None = None
        self._forwarded_at = -inf
        self._convergence: Convergence | None = None
        self._settle_deadline = inf
        self._closers: list[threading.Thread] = []
        self._stood_still = 0.0  # [s] a standstill of the process that was not acted on yet
        self._logs_at = -inf  # last creation of the log blocks [s]
        self._late_since, self._late_until = inf, -inf  # begin and end of a queue before the radio [s]
        self._share = 1.0  # share of the rates of logs and setpoints that were chosen
        rate = max(settings.stream_hz, LOOP_HZ)
        if isinstance(settings.positioning, Outside):
            rate = max(rate, settings.positioning.rate_hz)
        self._ticks = Ticks(rate)
        self._thread = threading.Thread(target=self._run, name=f"pilot of {name}", daemon=True)

    # ------------------------------------------------------------------ calls of the robot's loop, none blocks

    def start(self) -> None:
        """Start the thread, which connects."""
        self._thread.start()

    def give_order(self, what: str, height: float = 0.0) -> None:
        """Queue an order; it replaces a waiting one, except a stop, which nothing replaces."""
        with self._lock:
            if self._order is None or self._order[0] != "stop":
                self._order = what, height, uptime()
        self._wake.set()

    def set_target(self, now: float, target: Target | None) -> None:
        """See `FlightControl.set_target`."""
        self._flight.set_target(now, target)

    def locate(self, now: float, position: Vector, yaw: float) -> None:
        """Store an external position [m] and yaw [rad], or NaN, for the estimator on board."""
        self._external_pose = now, position, yaw
        self._flight.note_external(float(position[2]), yaw, uptime() - now)

    @property
    def note(self) -> str:
        """Connection state and faults, for users."""
        return "; ".join(
            part
            for part in (
                self._connection_note,
                self._flight.trouble,
                self._flight.turned if self._flight.airborne else "",
                "" if self._flight.airborne else self._flight.late,
                self._flight.muted,
                self._telemetry.status_text(),
                "its radio carries less than was measured: fewer logs" if self._share < 1.0 else "",
            )
            if part
        )

    @property
    def refusal(self) -> str:
        """Reason why the drone on the ground would refuse to take off; empty if it would not."""
        return "" if self._flight.airborne else self._flight.takeoff_refusal()

    @property
    def exchanges(self) -> int:
        """Packets received over the current link."""
        return 0 if self.link is None else self.link.exchanges

    @property
    def firmware(self) -> str | None:
        """Version of the firmware; None before the drone has said it."""
        return None if self.link is None else self.link.firmware

    @property
    def delay(self) -> float:
        """Delay [s] of positions from outside in the last climb; NaN if that is not known."""
        system = self._settings.positioning
        return self._telemetry.climb.delay(system.position_sigma) if isinstance(system, Outside) else nan

    def close(self, *, land: bool = True) -> None:
        """Land the drone if it flies, unless it is to be left as it is, then end the thread."""
        self._end_by = uptime() + (max(LANDING_S, self._flight.landing_s) if land else 0.0)
        self._ending.set()
        self._wake.set()

    def join(self) -> None:
        """Wait for the end of the thread."""
        if self._thread.ident is not None:
            self._thread.join(self._end_by - uptime() + JOIN_S)

    # ------------------------------------------------------------------ the thread

    def _run(self) -> None:
        while not self._ending.is_set() or (self._flight.airborne and uptime() < self._end_by):
            try:
                link = self._connect_in_turn()
            except Exception as error:  # noqa: BLE001 - of any kind: the robot must stay in reach of a stop
                self._connection_note = _text(error)
                self._fail(error)
                if self._flight.mark_out_of_reach() and self._ending.is_set():
                    break
                self._ending.wait(RETRY_S)
                continue
            try:
                self.link = self._flight.link = link
                link.confirmed = self._wake.set
                self._prepare(link)
                self._serve(link)
                break
            except BodyError as error:
                self._connection_note = str(error)
                self._fail(error)
                self._ending.wait(RETRY_S)
            except Exception as error:  # noqa: BLE001 - of any kind: the robot must be landed
                self._connection_note = f"link lost: {_text(error)}; connecting again"
                self._fail(error)
                if self._flight.airborne:
                    self.give_order("land")
            finally:
                self._discard(link)
        for closer in self._closers:
            closer.join()

    def _fail(self, error: Exception) -> None:
        """Record a failure of the first connection; retries go on, because other drones of the body may fly."""
        if not self.opened.is_set():
            self.failure = BodyError(f"{self._name}: {_text(error)}")

    def _connect_in_turn(self) -> CrazyflieLink:
        """Connect for the first time when no other drone of the radio does; again at once, because it may fly.

        Then the tables of contents are read once for all, by a drone that has the radio for itself. Raises LinkError.
        """
        if self.opened.is_set():
            return self._connect()
        self._connection_note = self._connection_note or "waits for the other drones of its radio to connect"
        while not self._turn.acquire(timeout=RETRY_S):
            if self._ending.is_set():
                raise LinkError("asked to end")
        try:
            return self._connect()
        finally:
            self._turn.release()

    def _connect(self) -> CrazyflieLink:
        """Open a new link, in as many attempts as the time allows; raises LinkError if all attempts fail."""
        begin = uptime()
        answered = False
        while True:
            link = CrazyflieLink(self._address)
            try:
                link.open(begin + self._settings.connect_s, self._ending)
            except SilentError as error:
                answered = answered or link.answered
                self._discard(link)
                waited = uptime() - begin
                if self._ending.is_set() or waited > (self._settings.connect_s if answered else NO_ANSWER_S):
                    raise LinkError(f"{error} at {self._address}: {self._remedy()}") from None
            except Exception as error:
                self._discard(link)
                raise LinkError(f"{self._address}: {_text(error)}; {self._remedy()}") from error
            else:
                return link

    def _remedy(self) -> str:
        if self._address.startswith("radio"):
            return (
                "is the drone on, the Crazyradio plugged in and permitted (udev), channel and address as on the robot?"
            )
        if self._address.startswith("usb"):
            return "is the drone plugged in, switched on, and permitted (udev)?"
        return "is the simulation running there?"

    def _discard(self, link: CrazyflieLink) -> None:
        """Close a link in a thread of its own: closing takes a second."""
        closer = threading.Thread(target=link.close, name=f"closing {self._name}", daemon=True)
        closer.start()
        self._closers = [other for other in self._closers if other.is_alive()] + [closer]

    def _prepare(self, link: CrazyflieLink) -> None:
        """Start the logs, and set the drone up, unless it is in the air, or was set up and has not moved since.

        Raises:
            BodyError: If the setup fails.
            LinkError: If the link is lost.
        """
        settings, telemetry = self._settings, self._telemetry
        telemetry.reset_status()
        self._share = 1.0
        self._flight.scale_setpoints(1.0)
        link.define_trajectories(stops=self._flight.outside)  # defined before answers wait behind logs
        ranges_hz = settings.ranges_hz if settings.multiranger else None
        telemetry.start_logging(link, log_hz=settings.log_hz, ranges_hz=ranges_hz)
        link.ask_firmware()
        deadline = uptime() + STATUS_S
        while telemetry.status_time == -inf:
            self._check_link(link)
            if uptime() > deadline:
                raise LinkError("no status received")
            time.sleep(0.01)
        if telemetry.stamps.restarted:
            telemetry.settled = telemetry.stamps.restarted = False
        if self._flight.resume():
            self._connection_note, self._convergence = IN_THE_AIR, None
            for parameter, value in self._safe_parameters(link).items():
                link.send_parameter(parameter, value)
            if self._order is None:
                self.give_order("land")
        else:
            self._set_up(link)

    def _safe_parameters(self, link: CrazyflieLink) -> dict[str, float]:
        """Parameters to set that were not chosen."""
        chosen = self._settings.parameters
        return {
            name: value for name, value in SAFE_PARAMETERS.items() if name not in chosen and link.has_parameter(name)
        }

    def _set_up(self, link: CrazyflieLink) -> None:
        """Set parameters and positioning of a drone on the ground.

        An estimator that measures no place is reset to the start once only: the drone may have landed elsewhere.

        Raises:
            BodyError: If the setup fails.
            LinkError: If the link is lost.
        """
        settings, telemetry = self._settings, self._telemetry
        if telemetry.settled and settings.positioning is None:
            self._arrive()
            return
        if Info.CRASHED in telemetry.info and settings.recover:
            link.cf.supervisor.send_crash_recovery_request()
        telemetry.settled = False
        for parameter, value in (self._safe_parameters(link) | settings.parameters).items():
            link.set_parameter(parameter, value)
        configure(link, settings)
        for _ in range(3):
            link.cf.commander.send_notify_setpoint_stop()  # setpoints of an earlier session have muted the planner
        if isinstance(settings.positioning, Outside):
            self._convergence, self._settle_deadline = None, inf
            self._connection_note = "no position from outside yet"
            self.opened.set()
        else:
            self._converge(link)
            self._arrive()

    def _converge(self, link: CrazyflieLink) -> None:
        self._connection_note = "position estimate is settling"
        deadline = uptime() + self._settings.converge_s
        absolute = self._settings.positioning is not None  # a Flow deck measures velocities
        convergence = Convergence(link, *self._start_pose, absolute=absolute)
        while not convergence.advance(uptime()):
            self._check(link)
            if uptime() > deadline or self._ending.is_set():
                cause = self._telemetry.status_text() or "does its positioning system work where it stands?"
                raise BodyError(f"its position has not settled after {self._settings.converge_s:g} s: {cause}")
            time.sleep(0.02)

    def _arrive(self) -> None:
        self._telemetry.settled = True
        self._connection_note = ""
        self.opened.set()

    def _serve(self, link: CrazyflieLink) -> None:
        """Loop of the thread, until `close` or the loss of the link; raises LinkError if the link is lost."""
        ticks = self._ticks
        ticks.start()
        landing = False
        link.take_gap()
        while True:
            begin, wait = uptime(), ticks.until_next()
            self._wake.wait(wait)
            self._wake.clear()
            now = self._note_standstill(begin + wait)
            if ticks.elapsed() >= ticks.next:  # else an order has woken it
                ticks.begin()
            self._check(link)
            try:
                self._mend_gap(link, now)
                self._execute_order()
                self._flight.update_phase(now)
                self._flight.send_due(now)
                self._forward_external_pose(link, now)
            except OrderReplaced:
                self._wake.set()
            if self._connection_note == IN_THE_AIR and not self._flight.airborne:
                self._set_up(link)
            if self._ending.is_set() and self._order is None:
                if self._flight.at_rest or now > self._end_by:
                    return
                if not landing and self._flight.airborne:
                    landing = True
                    self.give_order("land")

    def _execute_order(self) -> None:
        with self._lock:
            order, self._order = self._order, None
        if order is None:
            return
        what, height, given = order
        self._executing = what
        try:
            if what == "stop":
                self._flight.stop()
            elif what == "land":
                self._flight.land()
            elif uptime() - given < TAKEOFF_EXPIRY_S:
                self._flight.takeoff(height)
        finally:
            self._executing = ""
            self._flight.publish_airborne()

    def _check(self, link: CrazyflieLink) -> None:
        self._check_link(link)
        if self._telemetry.stamps.restarted:
            self._telemetry.settled = False
            raise LinkError("it was switched off and on")

    def _check_link(self, link: CrazyflieLink) -> None:
        if link.error is not None:
            raise LinkError(link.error)
        if link.gap > (RADIO_LOST_S if link.is_radio else LOST_S):
            raise LinkError(f"no packet for {link.gap:.1f} s")

    def _mend_gap(self, link: CrazyflieLink, now: float) -> None:
        """After a gap: hold or land, and log again. The link stays: its polls have gone on."""
        gap = max(link.take_gap() if link.is_radio else 0.0, self._stood_still)
        self._stood_still = 0.0
        silent = now - max(self._telemetry.arrival, self._logs_at)
        if gap > LOGS_S or (silent > LOGLESS_S + 3.0 / self._settings.log_hz and link.gap < LOGLESS_S):
            self._logs_at = now
            link.restart_logs()
        late = self._telemetry.arrival - self._telemetry.status_time  # [s] time in queues
        if not late > QUEUE_S:
            self._late_since = inf
        else:
            self._late_since, self._late_until = min(self._late_since, now), now
        if now - self._late_since > LATE_S:
            self._late_since = now + SLOWING_S
            self._scale_rates(link, max(0.5 * self._share, LEAST_SHARE))
        elif self._share < 1.0 and self._flight.phase is FlightPhase.GROUND and now - self._late_until > CALM_S:
            self._scale_rates(link, 1.0)  # it was this computer that was busy; in the air nothing is tried
        self._flight.land_after_gap(gap)

    def _scale_rates(self, link: CrazyflieLink, share: float) -> None:
        self._share = share
        link.scale_logs(share)
        self._flight.scale_setpoints(share)

    def _pause(self, seconds: float) -> None:
        """Wait in an order; raises LinkError if the link is lost, OrderReplaced after a standstill or another order.

        A stop replaces all; a landing, and the end of the process, replace a take-off.
        """
        link = self._flight.link
        until = uptime() + seconds
        while True:
            self._check(link)
            order = "" if self._order is None else self._order[0]
            coming_down = order == "land" or self._ending.is_set()
            if order == "stop" or (coming_down and self._executing == "takeoff"):
                raise OrderReplaced
            now = uptime()
            self._forward_external_pose(link, now)
            if now >= until:
                return
            time.sleep(min(until - now, self._ticks.period))
            self._note_standstill(until)
            if self._stood_still:
                raise OrderReplaced

    def _note_standstill(self, due: float) -> float:
        """Note whether a wait until `due` [s] took far longer, as in a suspended process; returns now."""
        now = uptime()
        late = now - due
        if late > LANDING_GAP_S:
            self._stood_still = late
        return now

    def _forward_external_pose(self, link: CrazyflieLink, now: float) -> None:
        """Send external poses to the estimator on board at the rate set; end its convergence."""
        system = self._settings.positioning
        if not isinstance(system, Outside):
            return
        pose = self._external_pose
        if pose is not None and now - self._forwarded_at >= 0.9 / system.rate_hz and not link.busy:
            self._external_pose = None
            measured, position, yaw = pose
            if uptime() - measured > EXTERNAL_AGE_S or not self._is_near(link, now, position, yaw):
                return
            self._forwarded_at = now
            x, y, z = position
            self._telemetry.climb.tell(now, z)
            if system.attitude and isfinite(yaw):
                link.cf.extpos.send_extpose(x, y, z, 0.0, 0.0, sin(0.5 * yaw), cos(0.5 * yaw))
            else:
                link.cf.extpos.send_extpos(x, y, z)
        if self._convergence is not None and self._convergence.reset and not self._convergence.done:
            if self._convergence.advance(now):
                if self._connection_note != IN_THE_AIR:
                    self._arrive()
            elif now > self._settle_deadline and not self._flight.airborne:
                self._connection_note = "its position has not settled: are the external positions those of this robot?"

    def _is_near(self, link: CrazyflieLink, now: float, position: Vector, yaw: float) -> bool:
        """Whether the estimate is near an external pose; if not, after setup or a gap, reset it there.

        The firmware's filter is thrown by a position far from its estimate: in the air the yaw turns, and it falls.
        """
        telemetry, convergence = self._telemetry, self._convergence
        if convergence is not None and not convergence.reset:
            convergence.advance(now)
            return convergence.reset
        far = convergence is None and self._flight.phase is FlightPhase.GROUND
        if now - self._forwarded_at > BLIND_S and not far:
            if now - telemetry.status_time > HOLD_AGE_S:
                return False  # its pose is that of before the gap
            far = distance((telemetry.pose[0], telemetry.pose[1], telemetry.pose[2]), position) > FAR
        if not far:
            return True
        if self._flight.phase is FlightPhase.GROUND:
            telemetry.settled = False
            self._connection_note = "position estimate is settling"
        here = telemetry.pose[6] if telemetry.settled else self._start_pose[1]
        self._convergence = Convergence(link, position, yaw if isfinite(yaw) else here, absolute=True)
        self._settle_deadline = now + self._settings.converge_s
        return False


def _text(error: Exception) -> str:
    return str(error) if isinstance(error, LinkError | BodyError) else f"{type(error).__name__}: {error}"
