"""The thread that serves one Crazyflie: connects, sets up, obeys, streams, watches, and connects again."""

from __future__ import annotations

import threading
import time
from math import cos, inf, isfinite, sin
from typing import Final

from agents.arrays import Array
from agents.body.interface import TROUBLE, BodyError
from agents.protocols.crazyflie import Outside, Settings
from bridges.crazyflie.flight import Flight, Phase, Target
from bridges.crazyflie.link import Link, LinkError, SilentError
from bridges.crazyflie.positioning import Convergence, configure
from bridges.crazyflie.telemetry import Telemetry

NOBODY_S: Final = 2.4  # without any answer there is no Crazyflie
LOST_S: Final = 1.0  # without a packet the link is lost; the firmware gives up after two seconds without setpoints
LINK_GAP_S: Final = 2.0  # so long after the link was lost, a Crazyflie that streamed setpoints held up is down
STATUS_S: Final = 2.0  # to the first status
RETRY_S: Final = 0.5
HOME_S: Final = 12.0  # `close` waits so long for a landing
JOIN_S: Final = 5.0

TOO_LATE_S: Final = 2.0  # a take-off that could not begin for so long does not begin any more

Order = tuple[str, float, float]  # "takeoff", "land" or "stop", the height of a take-off, and when it was given


class Overruled(RuntimeError):
    """A newer order has come."""


class Pilot:
    """Serves one row.

    Attributes:
        opened: It was connected, set up, and knew where it was (unless somebody outside must tell it) at least once.
        failure: Why the first connection failed.
    """

    def __init__(
        self, name: str, address: str, settings: Settings, telemetry: Telemetry, place: tuple[Array, float]
    ) -> None:
        """`place` is where the robot stands: (3,) [m], and its yaw [rad]."""
        self.opened = threading.Event()
        self.failure: BodyError | None = None
        self._name, self._address, self._settings, self._telemetry = name, address, settings, telemetry
        self._place = place
        self._flight = Flight(settings, telemetry, self._pause)
        self._link: Link | None = None
        self._news = "connecting"
        self._order: Order | None = None
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._ending = threading.Event()
        self._outside: tuple[float, Array, float] | None = None
        self._passed = -inf
        self._convergence: Convergence | None = None
        self._patient_until = inf
        self._closers: list[threading.Thread] = []
        period = settings.stream_hz
        if isinstance(settings.positioning, Outside):
            period = max(period, settings.positioning.rate_hz)
        self._period = 1.0 / period
        self._thread = threading.Thread(target=self._run, name=f"pilot of {name}", daemon=True)

    # ------------------------------------------------------------------ from the robot's loop: none of these blocks

    def start(self) -> None:
        """Begins to connect."""
        self._thread.start()

    def give(self, what: str, height: float = 0.0) -> None:
        """An order; it replaces one that has not been taken up yet, except that nothing replaces a stop."""
        with self._lock:
            if self._order is None or self._order[0] != "stop":
                self._order = what, height, time.monotonic()
        self._wake.set()

    def aim(self, now: float, target: Target | None) -> None:
        """See `Flight.aim`."""
        self._flight.aim(now, target)

    def locate(self, now: float, position: Array, yaw: float) -> None:
        """A position (3,) [m] and yaw [rad], or NaN, from outside, for the estimator on board."""
        self._outside = now, position, yaw

    @property
    def note(self) -> str:
        """What there is to say, for people."""
        return "; ".join(part for part in (self._news, self._flight.trouble, self._telemetry.words()) if part)

    def close(self) -> None:
        """Lands it if it flies, and ends the thread."""
        self._ending.set()
        self._wake.set()

    def join(self) -> None:
        """Waits for the end of the thread."""
        if self._thread.ident is not None:
            self._thread.join(HOME_S + JOIN_S)

    # ------------------------------------------------------------------ the thread

    def _run(self) -> None:
        lost = inf
        while not self._ending.is_set() or self._flight.airborne:
            try:
                link = self._connect()
            except LinkError as error:
                self._news = str(error)
                self._fail(error)
                if time.monotonic() - lost > LINK_GAP_S or self._ending.is_set():
                    self._flight.doubt()
                self._ending.wait(RETRY_S)
                continue
            try:
                self._link = self._flight.link = link
                self._prepare(link)
                self._serve(link)
                break
            except BodyError as error:
                self._news = str(error)
                self._fail(error)
                self._ending.wait(RETRY_S)
            except TROUBLE as error:  # whatever it is, the robot must be landed
                lost = time.monotonic()
                what = str(error) if isinstance(error, LinkError) else f"{type(error).__name__}: {error}"
                self._news = f"link lost: {what}; connecting again"
                self._fail(error)
                if self._flight.airborne:
                    self.give("land")
            finally:
                self._discard(link)
        for closer in self._closers:
            closer.join()

    def _fail(self, error: Exception) -> None:
        """The first connection was none; it is tried on, in case others of the body were had."""
        if not self.opened.is_set():
            self.failure = BodyError(f"{self._name}: {error}")

    def _connect(self) -> Link:
        """A new link, by as many attempts as there is time for.

        Raises:
            LinkError: If there is none.
        """
        begin = time.monotonic()
        answered = False
        while True:
            link = Link(self._address)
            try:
                link.open(begin + self._settings.connect_s, self._ending)
            except SilentError as error:
                answered = answered or link.answered
                self._discard(link)
                waited = time.monotonic() - begin
                if self._ending.is_set() or waited > (self._settings.connect_s if answered else NOBODY_S):
                    raise LinkError(f"{error} at {self._address}: {self._remedy()}") from None
            except LinkError as error:
                self._discard(link)
                raise LinkError(f"{self._address}: {error}; {self._remedy()}") from None
            else:
                return link

    def _remedy(self) -> str:
        if self._address.startswith("radio"):
            return "is it on, the Crazyradio plugged in and permitted (udev), channel and address as on the robot?"
        if self._address.startswith("usb"):
            return "is it plugged in, switched on, and permitted (udev)?"
        return "is the simulation running there?"

    def _discard(self, link: Link) -> None:
        """Closes a link, which takes a second, on the side."""
        closer = threading.Thread(target=link.close, name=f"closing {self._name}", daemon=True)
        closer.start()
        self._closers = [other for other in self._closers if other.is_alive()] + [closer]

    def _prepare(self, link: Link) -> None:
        """Logs, parameters, positioning; nothing of it if the Crazyflie is in the air.

        Raises:
            BodyError: If it cannot be set up.
            LinkError: If it falls silent.
        """
        settings, telemetry = self._settings, self._telemetry
        telemetry.forget()
        ranges_hz = settings.ranges_hz if settings.multiranger else None
        telemetry.listen(link, log_hz=settings.log_hz, status_hz=settings.status_hz, ranges_hz=ranges_hz)
        deadline = time.monotonic() + STATUS_S
        while telemetry.told == -inf:
            self._check(link)
            if time.monotonic() > deadline:
                raise LinkError("it does not say how it is")
            time.sleep(0.01)
        if self._flight.resume():
            self._news = "connected again, in the air"
            return
        self._telemetry.board.placed[telemetry.row] = False
        for parameter, value in settings.parameters.items():
            link.set(parameter, value)
        configure(link, settings)
        for _ in range(3):
            link.cf.commander.send_notify_setpoint_stop()  # whoever streamed before muted the planner
        if settings.positioning is None:
            self._arrive()
        elif isinstance(settings.positioning, Outside):
            self._convergence, self._patient_until = None, inf
            self._news = "no position from outside yet"
            self.opened.set()
        else:
            self._converge(link)
            self._arrive()

    def _converge(self, link: Link) -> None:
        self._news = "finding out where it is"
        deadline = time.monotonic() + self._settings.converge_s
        convergence = Convergence(link, *self._place)
        while not convergence.advance(time.monotonic()):
            self._check(link)
            if time.monotonic() > deadline or self._ending.is_set():
                said = self._telemetry.words() or "does its positioning system work where it stands?"
                raise BodyError(f"its position has not settled after {self._settings.converge_s:g} s: {said}")
            time.sleep(0.02)

    def _arrive(self) -> None:
        self._telemetry.board.placed[self._telemetry.row] = True
        self._news = ""
        self.opened.set()

    def _serve(self, link: Link) -> None:
        """Until the end, or until the link is lost.

        Raises:
            LinkError: If it is.
        """
        due = time.monotonic()
        landed_by = inf
        while True:
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            now = time.monotonic()
            due = max(due + self._period, now) if now >= due else due
            self._check(link)
            try:
                self._obey()
                self._pass_on(link, now)
                self._flight.watch(now)
                self._flight.guide(now)
            except Overruled:
                self._wake.set()
            if self._ending.is_set() and self._order is None:
                if not self._flight.airborne or now > landed_by:
                    return
                if landed_by == inf:
                    landed_by = now + HOME_S
                    self.give("land")

    def _obey(self) -> None:
        with self._lock:
            order, self._order = self._order, None
        if order is None:
            return
        what, height, given = order
        try:
            if what == "stop":
                self._flight.stop()
            elif what == "land":
                self._flight.land()
            elif time.monotonic() - given < TOO_LATE_S:
                self._flight.takeoff(height)
        finally:
            self._flight.show()

    def _check(self, link: Link) -> None:
        if link.error is not None:
            raise LinkError(link.error)
        silence = time.monotonic() - link.heard
        if silence > LOST_S:
            raise LinkError(f"nothing heard for {silence:.1f} s")

    def _pause(self, seconds: float) -> None:
        """Lets time pass in the middle of an order.

        Raises:
            LinkError: If the link is lost meanwhile.
            Overruled: If it must stop.
        """
        link = self._flight.link
        until = time.monotonic() + seconds
        while True:
            self._check(link)
            if self._order is not None and self._order[0] == "stop":
                raise Overruled
            now = time.monotonic()
            self._pass_on(link, now)
            if now >= until:
                return
            time.sleep(min(until - now, self._period))

    def _pass_on(self, link: Link, now: float) -> None:
        """Tells the estimator on board where it is, as often as wanted, and waits until it believes it."""
        system = self._settings.positioning
        if not isinstance(system, Outside):
            return
        told = self._outside
        if told is not None and now - self._passed >= 0.9 / system.rate_hz:
            self._outside, self._passed = None, now
            _, position, yaw = told
            x, y, z = position.tolist()
            if system.attitude and isfinite(yaw):
                link.cf.extpos.send_extpose(x, y, z, 0.0, 0.0, sin(0.5 * yaw), cos(0.5 * yaw))
            else:
                link.cf.extpos.send_extpos(x, y, z)
            if self._convergence is None and self._flight.phase is Phase.GROUND:
                self._news = "finding out where it is"
                start_yaw = yaw if isfinite(yaw) else self._place[1]
                self._convergence = Convergence(link, position, start_yaw)
                self._patient_until = now + self._settings.converge_s
        placed = self._telemetry.board.placed
        if self._convergence is not None and not placed[self._telemetry.row]:
            if self._convergence.advance(now):
                self._arrive()
            elif now > self._patient_until:
                self._news = "its position has not settled: do the positions from outside belong to this robot?"
