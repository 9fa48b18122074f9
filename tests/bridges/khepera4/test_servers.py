"""The Khepera bridge with each published server of Robotic Park, on a simulated clock: motion, gaps, refusals."""

import math
import socket

import pytest

from agents.protocols import khepera4 as protocol
from bridges.khepera4 import drivers
from bridges.khepera4.drivers import KTeam, UnknownAnswer, Wire, WrongServer
from tests.bridges.khepera4.lab import Lab


@pytest.fixture
def lab(monkeypatch):
    made = []

    def begin(server, **parts):
        made.append(Lab(server, monkeypatch, **parts))
        return made[-1]

    yield begin
    for each in made:
        each.close()


@pytest.fixture(params=protocol.PARK)
def robot(lab, request):
    """A robot with each of the servers."""
    return lab(request.param)


@pytest.mark.parametrize(("goal", "seconds"), [((0.6, 0.0), 15.0), ((0.3, 0.3), 12.0)])
def test_motion_within_5_percent_of_what_was_asked(robot, goal, seconds):
    robot.go_to(goal, seconds)
    x, y, _ = robot.truth
    assert math.hypot(x - goal[0], y - goal[1]) < 0.05 * math.hypot(*goal)
    assert (robot.odometer.x, robot.odometer.y) == pytest.approx((x, y), abs=0.006)
    assert robot.stands()


def test_a_goal_behind_is_reached(robot):
    robot.go_to((-0.3, 0.05), 18.0)
    assert robot.truth[:2] == pytest.approx((-0.3, 0.05), abs=0.015)


def test_speeds_are_those_that_were_asked_for(robot):
    robot.exchange(0.08, 0.3, periods=10)
    x, y, yaw = robot.truth
    robot.exchange(0.08, 0.3, periods=50)
    now = robot.truth
    assert now[2] - yaw == pytest.approx(0.6, rel=0.05)
    chord = 0.08 / 0.3 * 2.0 * math.sin(0.3)
    assert math.hypot(now[0] - x, now[1] - y) == pytest.approx(chord, rel=0.05)
    assert robot.odometer.yaw == pytest.approx(now[2], abs=0.02)


def test_link_gap_ends_in_stop_over_same_connection(robot):
    robot.exchange(0.1, periods=25)
    begin, x = robot.now, robot.truth[0]
    robot.gap_until = begin + 0.7
    with pytest.raises(TimeoutError):
        robot.exchange(0.1)
    robot.driver.patience_s = 0.2  # as `Khepera4Link` does
    while True:
        try:
            robot.exchange(0.0)
            break
        except TimeoutError:
            assert robot.now < begin + 1.5
    robot.sleep(0.1)
    assert robot.stands()
    assert robot.truth[0] - x < 0.1  # all that it drove since the gap began
    assert robot.odometer.x == pytest.approx(robot.truth[0], abs=0.02)  # what it drove unheard is estimated


def test_command_that_waited_too_long_becomes_a_stop(robot):
    robot.exchange(0.1, periods=25)
    robot.driver.drive(0.1, 0.0, robot.now - 0.1)  # the process was suspended between decision and sending
    robot.driver.move(robot.odometer)
    robot.sleep(0.2)
    assert robot.stands()


def test_nothing_sent_looks_like_a_goal_to_servers(robot):
    robot.exchange(0.1, periods=5)
    goals = [read for read in robot.heard if read[:1] == b"g"]
    assert not robot.driver.ranged
    assert bool(goals) == (not robot.driver.server.drives)
    assert b"get_data" not in goals


def test_way_during_machine_sleep_is_counted(robot):
    """The robot drives on; the machine's monotonic clock leaves the sleep out, its uptime does not."""
    robot.exchange(0.1, periods=25)
    x, counted = robot.truth[0], robot.odometer.x
    robot.sleep(10.0)
    robot.monotonic = lambda: robot.now - 10.0
    robot.exchange(0.0, periods=25)
    assert robot.odometer.x - counted == pytest.approx(robot.truth[0] - x, abs=0.1)


def test_way_that_is_reported_late_is_counted_once(lab):
    robot = lab("2023-01-07")
    robot.driver.patience_s = 0.2
    robot.exchange(0.2)
    robot.gap_until = robot.now + 0.5
    for _ in range(2):
        with pytest.raises(TimeoutError):
            robot.exchange(0.0)
    robot.sleep(0.3)
    robot.exchange(0.0, periods=20)
    assert robot.odometer.x == pytest.approx(robot.truth[0], abs=0.001)


@pytest.mark.parametrize("server", ["2023-04-10", "2025-05"])
def test_server_that_gives_its_year_is_identified(lab, server):
    assert lab(server, named=False).driver.server == protocol.PARK[server]


@pytest.mark.parametrize("server", ["2023-01-07", "2023-01-15", "fork"])
def test_ambiguous_server_is_asked_for_and_not_driven(lab, server):
    with pytest.raises(WrongServer, match=r'2023-01-07, 2023-01-15, fork do: .* device = { server = "2023-01-07" }'):
        lab(server, named=False)


def test_server_other_than_the_named_is_refused(lab):
    robot = lab("2025-05")
    with pytest.raises(WrongServer, match="as the server of 2025-05 does, not that of 2023-01-07"):
        drivers.identify(robot, protocol.Khepera4Settings(server="2023-01-07"), "2023-01-07")
    robot.program.kind = protocol.ParkServer("pose", 3, drives=True, per_turn=False, clients=1)
    with pytest.raises(WrongServer, match="as no known server does"):
        drivers.identify(robot, protocol.Khepera4Settings(), None)
    assert set(robot.heard) == {b"stop", b"p"}


def test_first_answer_may_take_seconds(lab):
    """A server of 2023 has one client in its life: one that does not wait for its answer is lost."""
    robot = lab("2025-05")
    receive = robot.receive

    def late(until):
        if until < robot.now + 2.5:
            raise TimeoutError
        robot.sleep(2.5)
        return receive(until)

    robot.receive = late
    assert drivers.identify(robot, protocol.Khepera4Settings(), None).server == protocol.PARK["2025-05"]


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


def test_endless_answer_of_kteam_is_refused():
    class Endless:
        """Wire of a device that never ends its line."""

        reads = 0

        def pending(self): ...

        def send(self, data): ...

        def receive(self, until):
            self.reads += 1
            assert self.reads < 1000
            return b"x" * 1024

    with pytest.raises(UnknownAnswer, match="without end"):
        KTeam(Endless(), protocol.Khepera4Settings()).begin()
