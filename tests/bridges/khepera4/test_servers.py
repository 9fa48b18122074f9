"""The Khepera drivers with each published server of Robotic Park, on a simulated clock and without sockets."""

import math
import socket
from contextlib import ExitStack, closing, suppress
from types import SimpleNamespace

import pytest

from agents.decision.position_control import PositionController
from bridges.khepera4 import drivers, protocol
from bridges.khepera4.drivers import KTeam, UnknownAnswer, Wire, WrongServer
from bridges.khepera4.kind import KHEPERA4
from bridges.khepera4.odometry import Odometer
from bridges.khepera4.twin import KheperaDevice
from tests.requests import request as robots
from tests.waiting import ManualClock
from twins.device import DeviceRequest, Faults

DT = 0.01


class Lab(ManualClock):
    """One robot, its twin, the wire between the driver and it, and the clock of the driver."""

    def __init__(self, server, monkeypatch, *, named=True):
        super().__init__()
        asked = robots("khepera4", ["khepera4-twin"], device={"server": server})
        self.device = KheperaDevice(DeviceRequest(asked, Faults()))
        self.program = self.device.servers[0].program
        self.due, self.gap_until, self.sent_at = DT, -math.inf, -math.inf
        self.queue, self.answers, self.heard = b"", b"", []
        monkeypatch.setattr(drivers, "time", self)
        monkeypatch.setattr(drivers, "uptime", self.monotonic)
        self.program.begin_session()
        self.device.servers[0].client = self
        self.odometer = Odometer(0.0, 0.0, 0.0)
        self.named = server if named else None

    def begin(self):
        self.driver = self.identify(self.named)
        self.driver.begin()
        self.driver.move(self.odometer)
        return self

    def identify(self, server):
        return drivers.identify(self, protocol.Khepera4Settings(server=server), server)

    def sleep(self, seconds):
        until = self.now + seconds
        while self.due < until:  # the twin moves in whole steps
            self.now = self.due
            self.due += DT
            self.device.advance(self.now)
            self._deliver()
        self.now = until
        self._deliver()

    def send(self, data):
        assert data != b"p" or self.now >= self.sent_at + protocol.GAP_S - 1e-9, "glued to what was sent before"
        self.queue, self.sent_at = self.queue + data, self.now
        self._deliver()

    def pending(self):
        answers, self.answers = self.answers, b""
        return answers

    def receive(self, until):
        while not self.answers:
            if self.now >= until:
                raise TimeoutError
            self.sleep(0.001)
        return self.pending()

    def _deliver(self):
        if self.queue and self.now >= self.gap_until:
            read, self.queue = self.queue[:255], self.queue[255:]
            self.heard.append(read)
            self.answers += self.program.answer(read, self.now)

    @property
    def truth(self):
        position, yaw = self.device.truth()
        return *position[0, :2].tolist(), float(yaw[0])

    def exchange(self, v, turn=0.0, periods=1):
        """Periods of the link, of 40 ms each."""
        for _ in range(periods):
            due = self.now + 0.04
            self.driver.drive(v, turn)
            self.driver.move(self.odometer)
            self.sleep(max(0.0, due - self.now))

    def stands(self):
        before = self.truth
        self.exchange(0.0, periods=25)
        return self.truth == before

    def close(self):
        self.device.servers[0].client = None
        self.device.close()


@pytest.fixture
def begin_lab(monkeypatch):
    with ExitStack() as made:
        yield lambda server, **parts: made.enter_context(closing(Lab(server, monkeypatch, **parts))).begin()


@pytest.fixture(params=protocol.PARK)
def served(begin_lab, request):
    return begin_lab(request.param)


@pytest.mark.parametrize(("goal", "seconds"), [((0.6, 0.0), 15.0), ((0.3, 0.3), 12.0), ((-0.3, 0.05), 18.0)])
def test_motion_within_5_percent_of_what_was_asked(served, goal, seconds):
    law, at = PositionController(KHEPERA4), served.odometer
    while served.now < seconds:
        served.exchange(*law.setpoint((*goal, 0.0), math.nan, (at.x, at.y, 0.0), at.yaw)[:2])
    place = served.truth[:2]
    assert math.dist(place, goal) < 0.05 * math.hypot(*goal)
    assert (at.x, at.y) == pytest.approx(place, abs=0.006)
    assert served.stands()


def test_speeds_are_those_that_were_asked_for(served):
    served.exchange(0.08, 0.3, periods=10)
    *place, yaw = served.truth
    served.exchange(0.08, 0.3, periods=50)
    *now, heading = served.truth
    chord = 0.08 / 0.3 * 2.0 * math.sin(0.3)
    assert [heading - yaw, math.dist(now, place)] == pytest.approx([0.6, chord], rel=0.05)
    assert served.odometer.yaw == pytest.approx(heading, abs=0.02)
    goals = [read for read in served.heard if read[:1] == b"g"]  # other texts that begin so would be goals to servers
    assert (served.driver.ranged, bool(goals), b"get_data" in goals) == (False, not served.driver.server.drives, False)


def test_link_gap_ends_in_stop_over_same_connection(served):
    served.exchange(0.1, periods=25)
    begin, x = served.now, served.truth[0]
    served.gap_until = begin + 0.7
    with pytest.raises(TimeoutError):
        served.exchange(0.1)
    served.driver.patience_s, ended = 0.2, False  # as `Khepera4Link` does
    while not ended:
        with suppress(TimeoutError):
            served.exchange(0.0)
            ended = True
        assert served.now < begin + 1.5
    served.sleep(0.1)
    assert served.stands()
    assert served.truth[0] - x < 0.1  # all that it drove since the gap began
    assert served.odometer.x == pytest.approx(served.truth[0], abs=0.02)  # what it drove unheard is estimated


def test_request_that_the_network_glued_is_sent_again(served):
    """The second of two words in one segment is lost: a busy network costs 0.15 s, and no halt."""
    served.exchange(0.1, periods=25)
    for _ in range(5):
        begin = served.now
        served.gap_until = begin + 0.035
        served.exchange(0.1)
        assert served.now - begin < 0.25
        served.exchange(0.1, periods=5)
    if served.driver.server.drives:  # else it slows down at its goal, unseen
        assert served.odometer.x == pytest.approx(served.truth[0], rel=0.05)


def test_command_that_waited_too_long_becomes_a_stop(served):
    served.exchange(0.1, periods=25)
    served.driver.drive(0.1, 0.0, served.now - 0.1)  # the process was suspended between decision and sending
    served.driver.move(served.odometer)
    served.sleep(0.2)
    assert served.stands()


def test_way_during_machine_sleep_is_counted(served):
    """The robot drives on; the machine's monotonic clock leaves the sleep out, its uptime does not."""
    served.exchange(0.1, periods=25)
    x, counted = served.truth[0], served.odometer.x
    served.sleep(10.0)
    served.monotonic = lambda: served.now - 10.0
    served.exchange(0.0, periods=25)
    assert served.odometer.x - counted == pytest.approx(served.truth[0] - x, abs=0.1)


def test_way_that_is_reported_late_is_counted_once(begin_lab):
    served = begin_lab("2023-01-07")
    served.driver.patience_s = 0.2
    served.exchange(0.2)
    served.gap_until = served.now + 0.5
    for _ in range(2):
        with pytest.raises(TimeoutError):
            served.exchange(0.0)
    served.sleep(0.3)
    served.exchange(0.0, periods=20)
    assert served.odometer.x == pytest.approx(served.truth[0], abs=0.001)


def test_ambiguous_server_is_asked_for_and_not_driven(begin_lab):
    for year in ("2023-04-10", "2025-05"):
        assert begin_lab(year, named=False).driver.server == protocol.PARK[year]
    for server in ("2023-01-07", "2023-01-15", "fork"):
        with pytest.raises(WrongServer, match=r"2023-01-07, 2023-01-15, fork do: .* device = { server = "):
            begin_lab(server, named=False)


def test_server_other_than_the_named_is_refused(begin_lab):
    served = begin_lab("2025-05")
    with pytest.raises(WrongServer, match="as the server of 2025-05 does, not that of 2023-01-07"):
        served.identify("2023-01-07")
    served.program.kind = protocol.ParkServer("pose", 3, drives=True, per_turn=False, clients=1)
    with pytest.raises(WrongServer, match="as no known server does"):
        served.identify(None)
    assert set(served.heard) == {b"stop", b"p"}


def test_first_answer_may_take_seconds(begin_lab):
    """A server of 2023 has one client in its life: one that does not wait for its answer is lost."""
    served = begin_lab("2025-05")
    served.gap_until = served.now + 2.5
    assert served.identify(None).server == protocol.PARK["2025-05"]


def test_endless_input_holds_no_thread():
    """Of a wrong device, which sends on and on: it is no answer, and the connection can be closed."""
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    with theirs:
        wire, sent = Wire(ours.fileno(), ours.close), 0
        while sent <= 2 * drivers.MAX_INPUT_BYTES:
            sent += theirs.send(bytes(1 << 12))
        with pytest.raises(UnknownAnswer, match="without end"):
            wire.pending()
        wire.close()
    assert ours.fileno() == -1
    endless = SimpleNamespace(pending=lambda: b"", send=lambda _: None, receive=lambda _: b"x" * 1024)
    with pytest.raises(UnknownAnswer, match="without end"):
        KTeam(endless, protocol.Khepera4Settings()).begin()
