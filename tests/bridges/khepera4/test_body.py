"""The Khepera bridge: odometry by numbers, and real sockets between bridge and twin."""

import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from contextlib import ExitStack, closing
from dataclasses import replace
from math import nan
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import BodyError
from agents.decision.position_control import PositionController
from agents.kinds.khepera4 import KHEPERA4
from agents.protocols import khepera4 as protocol
from bridges.khepera4 import body as khepera4
from bridges.khepera4 import drivers
from bridges.khepera4.body import OPEN_S, KheperaBody
from bridges.khepera4.link import Khepera4Link, KheperaAddress, KheperaOdometry
from bridges.khepera4.odometry import Odometer
from tests.bridges.columns import Columns
from tests.twins.loopback import Served, reached, request
from tests.waiting import until
from twins.devices import khepera4 as twin
from twins.devices.device import Faults
from twins.devices.khepera4 import KheperaDevice

TICK = 0.01
PARK, KTEAM = {"server": "2025-05"}, {"server": "kteam"}
ONCE = {"server": "2023-01-07"}


class Drive:
    """Drives a body as the runtime does."""

    def __init__(self, body, goals=None, truth=None):
        self.body, self.truth = body, truth
        self.goal = None if goals is None else [(x, y, 0.0) for x, y in goals]
        self.zero, self.tick, self.slowest = time.monotonic(), 0, 0.0
        self.pause, self.state = threading.Event(), None

    def once(self):
        self.tick = max(self.tick + 1, int((time.monotonic() - self.zero) / TICK))
        self.pause.wait(max(0.0, self.zero + self.tick * TICK - time.monotonic()))
        t = self.tick * TICK
        if self.truth is not None:
            position, yaw = self.truth()
            for row in range(len(yaw)):
                self.body.locate(row, t, tuple(position[row].tolist()), float(yaw[row]))
        begin = time.monotonic()
        states = self.body.read(t)
        self.state = Columns(states)
        if self.goal is not None:
            law = PositionController(KHEPERA4)
            pairs = zip(self.goal, states, strict=True)
            self.body.command([law.setpoint(goal, nan, state.position, state.yaw) for goal, state in pairs])
        self.slowest = max(self.slowest, time.monotonic() - begin)
        return t

    def until(self, true, patience=30.0):
        begin = self.once()
        while not true():
            assert self.once() - begin < patience, self.state
        return self.tick * TICK - begin


@pytest.fixture
def served():
    with ExitStack() as stack:
        yield lambda rows, **faults: stack.enter_context(Served(KheperaDevice, rows, **faults))


@pytest.fixture
def impatient(monkeypatch):
    """Bodies that are given up after a second, and servers that have half a second for their first answer."""
    monkeypatch.setattr(khepera4, "OPEN_S", 1.0)
    monkeypatch.setattr(drivers, "FIRST_ANSWER_S", 0.5)


def opened(body):
    body.open()
    return closing(body)


# ---------------------------------------------------------------------- by numbers


@given(st.lists(st.tuples(st.floats(-0.01, 0.01), st.floats(-0.05, 0.05)), max_size=40), st.floats(-3.0, 3.0))
def test_all_odometries_of_a_robot_agree(steps, yaw):
    ways = {kind: Odometer(1.0, 2.0, yaw) for kind in ("pose", "wheels", "steps", "heading")}
    x = y = theta = left = right = 0.0
    stamp = 0.0
    for way, turn in [(0.0, 0.0), *steps]:
        x += way * np.cos(theta + 0.5 * turn)
        y += way * np.sin(theta + 0.5 * turn)
        theta += turn
        left += (way - 0.5 * protocol.BASE * turn) / protocol.PULSE
        right += (way + 0.5 * protocol.BASE * turn) / protocol.PULSE
        stamp += 0.04
        ways["pose"].pose(x, y, np.remainder(theta + np.pi, 2 * np.pi) - np.pi, stamp)
        ways["wheels"].wheels(left, right, stamp)
        ways["steps"].steps(way, turn, stamp)
        ways["heading"].heading(way, theta, stamp)
    cos, sin = np.cos(yaw), np.sin(yaw)
    expected = (1.0 + cos * x - sin * y, 2.0 + sin * x + cos * y, yaw + theta)
    for odometer in ways.values():
        assert (odometer.x, odometer.y, odometer.yaw) == pytest.approx(expected, abs=1e-9)


def test_odometry_begins_where_the_experiment_says():
    odometer = Odometer(0.5, 0.0, np.pi / 2)
    odometer.pose(7.0, 8.0, 1.0, 0.0)
    assert (odometer.x, odometer.y, odometer.yaw) == (0.5, 0.0, np.pi / 2)
    odometer.pose(7.0 + np.cos(1.0), 8.0 + np.sin(1.0), 1.0, 1.0)  # one metre along its nose
    assert (odometer.x, odometer.y) == pytest.approx((0.5, 1.0))


def test_robot_switched_on_again_continues_where_it_was():
    odometer = Odometer(0.0, 0.0, 0.0)
    odometer.pose(0.0, 0.0, 0.0, 0.0)
    odometer.pose(0.3, 0.0, 0.0, 0.1)
    odometer.reconnected()
    odometer.pose(0.4, 0.0, 0.0, 0.2)  # its server lived on, it rolled a little
    assert odometer.x == pytest.approx(0.4)
    odometer.reconnected()
    odometer.pose(0.0, 0.0, 0.0, 0.3)  # its server is new
    assert odometer.x == pytest.approx(0.4)
    odometer.pose(0.1, 0.0, 0.0, 0.4)
    assert odometer.x == pytest.approx(0.5)
    odometer.pose(0.0, 0.0, 0.0, 0.5)  # it backs up over its zero: no doubt about that
    assert odometer.x == pytest.approx(0.4)


def test_velocity_follows_with_a_tenth_of_a_second():
    odometer = Odometer(0.0, 0.0, np.pi / 2)
    for step in range(26):
        odometer.steps(0.008, 0.0, 0.04 * step)
    assert odometer.velocity == pytest.approx((0.0, 0.2), abs=0.002)


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("khepera4://192.168.0.21", KheperaAddress(False, "192.168.0.21", 50000, "", None)),
        ("khepera4://kh1.lab:1234", KheperaAddress(False, "kh1.lab", 1234, "", None)),
        ("kteam://10.0.0.3:2000", KheperaAddress(True, "10.0.0.3", 2000, "", None)),
        ("kteam:///dev/ttyS0", KheperaAddress(True, "", 0, "/dev/ttyS0", None)),
        ("khepera4://kh1?server=2023-01-07", KheperaAddress(False, "kh1", 50000, "", "2023-01-07")),
    ],
)
def test_addresses(address, expected):
    assert KheperaAddress.parse("K", address) == expected


@pytest.mark.parametrize(
    "address",
    ["khepera4", "khepera4://", "kteam://10.0.0.3", "khepera4://h:port", "kteam:", "khepera4://h?server=2024",
     "khepera4://h?year=2023"],
)  # fmt: skip
def test_wrong_addresses_are_named(address):
    with pytest.raises(BodyError, match=f"^R0: {re.escape(address)}: "):
        KheperaBody(request("khepera4", [address]))


def test_wrong_settings_are_named():
    with pytest.raises(BodyError, match=r"^R0: device: .*poll_hz must be 2 to 30"):
        KheperaBody(request("khepera4", ["khepera4://h"], device={"poll_hz": 100.0}))
    with pytest.raises(BodyError, match=r"^R0: device: .*`servre`; its fields are server, poll_hz"):
        KheperaBody(request("khepera4", ["khepera4://h"], device={"servre": "fork"}))
    with pytest.raises(BodyError, match=r"^R0: device: .*ranges: the server of 2023-04-10 has no range poll"):
        KheperaBody(request("khepera4", ["khepera4://h"], device={"server": "2023-04-10", "ranges": True}))
    with pytest.raises(BodyError, match=r"^R0: device: .*poll_hz must be 22 to 30 with server = 'fork'"):
        KheperaBody(request("khepera4", ["khepera4://h"], device={"server": "fork", "poll_hz": 10}))


@pytest.mark.system
def test_nobody_there_is_said_with_the_remedy(impatient):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    begin = time.monotonic()
    with pytest.raises(BodyError) as caught:
        KheperaBody(request("khepera4", [f"khepera4://127.0.0.1:{port}", "kteam:///dev/ttyNONE"])).open()
    assert 1.0 < time.monotonic() - begin < 2.5
    assert OPEN_S < 5.0
    assert f"R0: 127.0.0.1:{port}: Connection refused; start the server on the robot" in str(caught.value)
    assert "R1: /dev/ttyNONE: No such file or directory; is the line plugged in" in str(caught.value)


@pytest.mark.parametrize("failure", [AssertionError, MemoryError, UnicodeError, StopIteration])
def test_link_outlives_failures_of_any_kind(failure):
    link = Khepera4Link(
        "K", KheperaAddress.parse("K", "khepera4://127.0.0.1"), protocol.Khepera4Settings(), (0.0, 0.0, 0.0)
    )
    tried = []

    def connect():
        tried.append(link.trouble)
        if len(tried) == 2:
            link.end()
        raise failure("broken")

    link._address = SimpleNamespace(connect=connect, serial="")
    link.start()
    link.join()
    assert f"{failure.__name__}: broken" in tried[1]


# ---------------------------------------------------------------------- with twins


@pytest.mark.system
@pytest.mark.parametrize(
    ("speaks", "bearings"), [((PARK, PARK), 0), ((KTEAM, KTEAM), 13), ((ONCE | {"ranges": True}, PARK), 5)]
)
def test_robots_drive_to_their_goals(served, speaks, bearings):
    rows = replace(request("khepera4", ["khepera4-twin"] * 2, yaw=0.5), device=speaks)
    twins = served(rows)
    goals = np.array([[0.25, 0.1], [-0.2, 0.95]])
    with opened(KheperaBody(reached(rows, twins.addresses))) as body:
        drive = Drive(body, goals)
        drive.until(lambda: np.abs(twins.truth()[0][:, :2] - goals).max() < 0.012)
        drive.goal = None
        body.land(range(2))
        drive.until(lambda: np.abs(drive.state.velocity).max() < 0.01)
        state, (position, yaw) = drive.state, twins.truth()
        assert [body.inspect(row).firmware for row in (0, 1)] == [f"server {each['server']}" for each in speaks]
        if bearings:
            drive.until(lambda: drive.state.scan[0] is not None)
            assert len(drive.state.scan[0].bearing) == bearings
            assert np.isnan(drive.state.scan[0].distance).all()
    assert state.position == pytest.approx(position, abs=0.01)
    assert state.yaw == pytest.approx(yaw, abs=0.03)
    assert not state.flying.any()
    assert state.note == ("", "")
    assert (state.battery > 0.98).all() if speaks[0] == KTEAM else np.isnan(state.battery).all()
    assert (np.abs(twins.truth()[0] - position) < 1e-3).all()


@pytest.mark.system
def test_link_gap_stops_robot_and_keeps_the_connection(served):
    """A server that accepts one client in its life, silent for 0.7 s: what is sent meanwhile comes glued together."""
    rows = request("khepera4", ["khepera4-twin"], device=ONCE)
    twins = served(rows, silent_from_s=2.0, silent_for_s=0.7)
    with opened(KheperaBody(reached(rows, twins.addresses))) as body:
        drive = Drive(body)
        drive.once()

        def forward():
            body.command([(0.1, 0.0, 0.0, 0.0)])
            return bool(drive.state.note[0])

        drive.until(forward)
        assert "no answer to p; it gets stops until it answers" in drive.state.note[0]
        drive.until(lambda: not drive.state.note[0])  # nothing is commanded meanwhile
        stood = twins.truth()[0][0, 0]
        drive.goal = [(stood + 0.3, 0.0, 0.0)]
        drive.until(lambda: twins.truth()[0][0, 0] > stood + 0.2)


@pytest.mark.system
def test_external_position_replaces_odometry(served):
    rows = request("khepera4", ["khepera4-twin"], external=True, start=[[0.3, 0.0, 0.0]])
    twins = served(rows)
    lied = reached(request("khepera4", ["-"], external=True, start=[[9.0, 9.0, 0.0]], yaw=2.0), twins.addresses)
    with opened(KheperaBody(lied)) as body:
        drive = Drive(body, [(0.5, 0.1)])
        drive.once()
        assert np.isnan(drive.state.position).all()
        drive.truth = twins.truth
        drive.until(lambda: np.abs(twins.truth()[0][0, :2] - [0.5, 0.1]).max() < 0.008)
        assert drive.state.position[0] == pytest.approx(twins.truth()[0][0], abs=0.004)


@pytest.mark.system
def test_fault_of_one_robot_leaves_others_driving(served):
    one = {speaks["server"]: request("khepera4", ["khepera4-twin"], device=speaks) for speaks in (PARK, KTEAM)}
    good, killed = served(one["2025-05"]), served(one["2025-05"])
    silent = served(one["kteam"], silent_from_s=1.0)
    empty = served(one["kteam"], battery=0.03)
    addresses = [each.addresses[0] for each in (good, killed, silent, empty)]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        absent = f"khepera4://127.0.0.1:{free.getsockname()[1]}"
    rows = request("khepera4", [*addresses, absent], start=[(0.0, 0.0, 0.0)] * 5)
    body = KheperaBody(rows)
    begin = time.monotonic()
    with opened(body):
        assert time.monotonic() - begin < 5.0
        drive = Drive(body, [(0.3, 0.0)] * 5)
        drive.until(lambda: killed.truth()[0][0, 0] > 0.02)
        killed.kill()
        drive.until(lambda: drive.state.note[1] and drive.tick * TICK - drive.state.time[1] > 0.5)
        drive.until(lambda: drive.state.note[2])
        drive.until(lambda: drive.tick * TICK - drive.state.time[2] > 0.5)
        notes = drive.state.note
        drive.until(lambda: abs(good.truth()[0][0, 0] - 0.3) < 0.008 and not drive.state.note[0])
        assert drive.slowest < 0.5
    assert notes[1].startswith("silent for")
    assert any(text in notes[1] for text in ("Connection refused", "closed the connection", "reset by peer"))
    assert "no answer to" in notes[2]
    assert notes[3] == "battery at 3%: too low to drive"
    assert empty.truth()[0][0, 0] == 0.0
    assert "Connection refused; start the server" in notes[4]
    assert np.isnan(drive.state.position[4]).all()


@pytest.mark.mechanism("Khepera IV bridge: link loss")
@pytest.mark.system
def test_lost_link_comes_back_and_goes_on(served):
    rows = request("khepera4", ["khepera4-twin"])
    first = served(rows)
    with opened(KheperaBody(reached(rows, first.addresses))) as body:
        drive = Drive(body, [(0.5, 0.0)])
        drive.until(lambda: first.truth()[0][0, 0] > 0.1)
        first.kill()
        drive.until(lambda: drive.state.note[0])
        stood = drive.state.position[0, 0]
        place = first.addresses[0].replace("khepera4://", "khepera4-twin://")
        second = served(request("khepera4", [place], start=[[stood, 0.0, 0.0]]))
        drive.until(lambda: not drive.state.note[0])
        drive.until(lambda: abs(second.truth()[0][0, 0] - 0.5) < 0.008)
        assert drive.state.position[0, 0] == pytest.approx(second.truth()[0][0, 0], abs=0.004)


@pytest.mark.system
@pytest.mark.parametrize(
    "speaks", [pytest.param(PARK, marks=pytest.mark.mechanism("Khepera IV bridge: no more setpoints")), KTEAM]
)
def test_wheels_stop_without_setpoints_and_at_closing(served, speaks):
    rows = request("khepera4", ["khepera4-twin"], device=speaks)
    twins = served(rows)
    with opened(KheperaBody(reached(rows, twins.addresses))) as body:
        drive = Drive(body)
        drive.once()
        body.command([(0.2, 0.0, 0.0, 0.0)])
        drive.until(lambda: drive.state.velocity[0, 0] > 0.1)
        drive.until(lambda: drive.state.velocity[0, 0] < 0.005)  # the setpoint is not given again
        went = twins.truth()[0][0, 0]
        assert 0.09 < went < 0.5  # half a second, the time to be heard, the time to stop
        body.command([(nan, 0.0, 0.0, 0.0)])
        body.command([(0.2, 0.0, 0.0, 0.0)])
        drive.until(lambda: twins.truth()[0][0, 0] > went + 0.02)

    def stands():
        before = twins.truth()[0][0, 0]
        drive.pause.wait(0.1)
        return twins.truth()[0][0, 0] == before

    until(stands, "it stands")


@pytest.mark.system
@pytest.mark.parametrize("speaks", [PARK, KTEAM])
def test_second_client_learns_that_another_holds_server(served, speaks, impatient, monkeypatch, tmp_path):
    rows = request("khepera4", ["khepera4-twin"], device=speaks)
    twins = served(rows)
    with opened(KheperaBody(reached(rows, twins.addresses))) as first:
        monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path))  # another user's, or another computer's
        with pytest.raises(BodyError, match=r"no answer to .*another program may hold it"):
            KheperaBody(reached(rows, twins.addresses)).open()
        drive = Drive(first)
        drive.once()
        assert drive.state.note == ("",)


@pytest.mark.system
def test_the_wrong_protocol_is_named(served, impatient):
    park, kteam = served(request("khepera4", ["-"], device=PARK)), served(request("khepera4", ["-"], device=KTEAM))
    crossed = [park.addresses[0].replace("khepera4", "kteam"), kteam.addresses[0].replace("kteam", "khepera4")]
    with pytest.raises(BodyError) as caught:
        KheperaBody(request("khepera4", crossed)).open()
    assert str(caught.value).count("the robot uses the other protocol") == 2
    older = served(request("khepera4", ["-"], device=ONCE))
    with pytest.raises(BodyError, match=r"answers p with .* write the one that runs there, such as device = { server"):
        KheperaBody(request("khepera4", older.addresses)).open()
    with pytest.raises(BodyError, match=r"no answer to p; a server of 2023 serves one client in its life: restart it"):
        KheperaBody(request("khepera4", older.addresses, device=ONCE)).open()


@pytest.mark.system
def test_park_never_gets_two_commands_at_once():
    """A server that notes what each of its reads brought."""
    reads = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            client, _ = listener.accept()
            with client:
                while data := client.recv(255):
                    reads.append(data.decode())
                    if data == b"p":
                        client.sendall(b"0.0000,0.0000")
                    elif data == b"get_data":
                        client.sendall(b"30,1000,2000,0,100")

        server = threading.Thread(target=serve, daemon=True)
        server.start()
        place = f"khepera4://127.0.0.1:{listener.getsockname()[1]}?server=2023-01-07"
        with opened(KheperaBody(request("khepera4", [place], device={"ranges": True}))) as body:
            drive = Drive(body, [(1.0, 0.0)])
            drive.until(lambda: len(reads) > 60)
            scan = drive.state.scan[0]
        server.join(2.0)
    assert {text.split()[0] for text in reads} == {"d", "p", "get_data", "stop"}
    assert all(len(text.split()) == 3 for text in reads if text[0] == "d")
    assert reads[0] == "stop"
    assert reads[-4:] == ["stop"] * 3 + ["p"]  # its answer shows that the stops were read
    assert scan.distance == pytest.approx([0.37, np.nan, np.nan, 0.32, 1.07], nan_ok=True)
    assert scan.bearing[0] == pytest.approx(np.pi / 2)


@pytest.mark.system
def test_wheels_with_link_broken_at_end_are_stopped():
    """A server that hangs up when it is told to stop, once."""
    lives = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            while len(lives) < 2:
                client, _ = listener.accept()
                reads = []
                lives.append(reads)
                with client:
                    while data := client.recv(255):
                        reads.append(data.decode())
                        if data == b"p":
                            client.sendall(b"0.00,0.00,0.00")
                        elif data == b"stop" and len(lives) == 1 and any(text[0] == "d" for text in reads):
                            break

        server = threading.Thread(target=serve, daemon=True)
        server.start()
        place = f"khepera4://127.0.0.1:{listener.getsockname()[1]}"
        with opened(KheperaBody(request("khepera4", [place]))) as body:
            drive = Drive(body, [(1.0, 0.0)])
            drive.until(lambda: any(text[0] == "d" for text in lives[0]))
        server.join(2.0)
    assert len(lives) == 2
    assert lives[1][-2:] == ["stop", "p"]


def test_a_stop_that_is_not_answered_is_said():
    link = Khepera4Link(
        "KH01", KheperaAddress.parse("KH01", "khepera4://127.0.0.1"), protocol.Khepera4Settings(), (0.0, 0.0, 0.0)
    )
    link.drive(0.2, 0.0, 0.0)
    link.odometry = KheperaOdometry(100.0, 0.0, 0.0, 0.0, (0.2, 0.0))
    link.halt(100.0)
    link.halt(101.0)  # again, by the watchdog
    assert not link.unanswered(102.0)
    assert link.unanswered(103.0)
    link.odometry = KheperaOdometry(103.0, 0.0, 0.0, 0.0, (0.0, 0.0))
    assert not link.unanswered(103.0)
    link.drive(0.2, 0.0, 0.0)
    link.odometry = KheperaOdometry(110.0, 0.0, 0.0, 0.0, (0.2, 0.0))
    assert not link.unanswered(110.0)


@pytest.mark.system
def test_serial_line_in_use_is_left_alone():
    ours, theirs = os.openpty()
    address = KheperaAddress.parse("KH01", f"kteam://{os.ttyname(theirs)}")
    first = address.connect()
    link = Khepera4Link("KH02", address, protocol.Khepera4Settings(), (0.0, 0.0, 0.0))
    link.start()
    try:
        until(lambda: "another process has this line; end it first" in link.trouble, "it is named")
        assert not select.select([ours], [], [], 0.0)[0]  # nothing was said on it
    finally:
        link.end()
        first.close()
    address.connect().close()  # free again
    os.close(ours)
    os.close(theirs)


def test_kteam_over_a_serial_line():
    """A pseudo terminal with the twin's side of the protocol at its other end."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    robot = twin._WheeledRobot(request("khepera4", ["-"]), 0, Faults())
    ending = threading.Event()
    heard = []

    def serve():
        begun = b""
        while not ending.is_set():
            if select.select([ours], [], [], 0.02)[0]:
                *lines, begun = (begun + os.read(ours, 255)).split(b"\r")
                for line in lines:
                    heard.append(line.decode())
                    os.write(ours, f"{twin.answer_kteam(robot, line.decode())}\r\n".encode())

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    try:
        with opened(KheperaBody(request("khepera4", [f"kteam://{os.ttyname(theirs)}"]))) as body:
            drive = Drive(body)
            drive.once()
            body.command([(0.1, 0.5, 0.0, 0.0)])
            drive.until(lambda: "D,109,186" in heard)
            assert drive.state.note == ("",)
            assert drive.state.battery[0] == 1.0
    finally:
        ending.set()
        server.join()
        os.close(ours)
        os.close(theirs)
    assert heard[:3] == ["D,0,0", "B", "U,31"]
    assert heard[-4:] == ["D,0,0"] * 3 + ["R"]


DRIVING = """
import sys, time
from bridges.khepera4.body import KheperaBody
from tests.twins.loopback import request

body = KheperaBody(request("khepera4", [sys.argv[1]]))
body.open()
zero, change = time.monotonic(), float(sys.argv[2])
while True:
    now = time.monotonic()
    body.read(now - zero)
    body.command([(0.10 if now < change else 0.05, 0.0, 0.0, 0.0)])
    time.sleep(0.002)
"""


@pytest.mark.system
def test_process_woken_from_suspension_sends_only_a_stop():
    """It drives at 0.10 m/s until a moment at which it is suspended, and at 0.05 m/s when it goes on."""
    reads = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            client, _ = listener.accept()
            with client:
                while data := client.recv(255):
                    reads.append((time.monotonic(), data))
                    if data == b"p":
                        client.sendall(b"0.0000,0.0000")

        threading.Thread(target=serve, daemon=True).start()
        place = f"khepera4://127.0.0.1:{listener.getsockname()[1]}?server=2023-01-07"
        begin = time.monotonic()
        child = subprocess.Popen([sys.executable, "-c", DRIVING, place, str(begin + 8.0)])
        try:
            until(lambda: any(data.startswith(b"d 10.0") for _, data in reads), "it drives")
            for _ in range(5):  # at any point of its loop
                os.kill(child.pid, signal.SIGSTOP)
                time.sleep(0.7)
                woke, known = time.monotonic(), len(reads)
                os.kill(child.pid, signal.SIGCONT)
                until(lambda known=known: len(reads) > known + 3, "it goes on")
            os.kill(child.pid, signal.SIGSTOP)
            until(lambda: time.monotonic() > begin + 8.5, "the moment is over")
            woke, known = time.monotonic(), len(reads)
            os.kill(child.pid, signal.SIGCONT)
            until(lambda: any(data.startswith(b"d 5.0") for at, data in reads[known:] if at > woke), "it drives slowly")
        finally:
            child.kill()
            child.wait()
    assert not [data for at, data in reads[known:] if at > woke and data.startswith(b"d 10.0")]
