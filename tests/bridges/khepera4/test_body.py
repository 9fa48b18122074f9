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
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import FRESH_S, BodyError
from agents.clock import uptime
from agents.kinds.khepera4 import KHEPERA4
from agents.protocols import khepera4 as protocol
from bridges.khepera4.body import OPEN_S, KheperaBody
from bridges.khepera4.link import Khepera4Link, KheperaAddress, KheperaOdometry
from bridges.khepera4.odometry import Odometer
from tests.bridges.driver import Driver, constant, toward
from tests.cases import mostly_slow
from tests.requests import request
from tests.twins.loopback import Served, reached
from tests.waiting import until
from twins.devices.device import DeviceRequest, Faults
from twins.devices.khepera4 import KheperaDevice, answer_kteam

PARK, KTEAM = {"server": "2025-05"}, {"server": "kteam"}
ONCE = {"server": "2023-01-07"}
IMPATIENT = {"open_s": 1.0, "first_answer_s": 0.5}
ONE = request("khepera4", ["khepera4-twin"])


@pytest.fixture
def served():
    with ExitStack() as stack:
        yield lambda rows, **faults: stack.enter_context(Served(KheperaDevice, rows, **faults))


@contextmanager
def opened(rows, *goals):
    """A process that drives a body toward goals (x, y) [m]."""
    body = KheperaBody(rows)
    body.open()
    with closing(body):
        yield Driver(body, toward(KHEPERA4, [(x, y, 0.0) for x, y in goals]) if goals else None)


def refusal(rows, **limits):
    """Why a body cannot be made or opened."""
    with pytest.raises(BodyError) as caught:
        KheperaBody(rows, **limits).open()
    return str(caught.value)


def link_of(address="khepera4://127.0.0.1"):
    """The link of one robot, not begun."""
    where = KheperaAddress.parse("K", address) if isinstance(address, str) else address
    return Khepera4Link("K", where, protocol.Khepera4Settings(), (0.0, 0.0, 0.0))


# ---------------------------------------------------------------------- by numbers


@given(st.lists(st.tuples(st.floats(-0.01, 0.01), st.floats(-0.05, 0.05)), max_size=40), st.floats(-3.0, 3.0))
def test_all_odometries_of_a_robot_agree(steps, yaw):
    ways = {kind: Odometer(1.0, 2.0, yaw) for kind in ("pose", "wheels", "steps", "heading")}
    x = y = theta = left = right = 0.0
    for k, (way, turn) in enumerate([(0.0, 0.0), *steps], 1):
        x += way * np.cos(theta + 0.5 * turn)
        y += way * np.sin(theta + 0.5 * turn)
        theta += turn
        left += (way - 0.5 * protocol.BASE * turn) / protocol.PULSE
        right += (way + 0.5 * protocol.BASE * turn) / protocol.PULSE
        stamp = 0.04 * k
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
    odometer, found = Odometer(0.0, 0.0, 0.0), []
    # its server lived on, and it rolled a little; its server is new; it backs up over its zero, without doubt
    for k, (x, anew) in enumerate([(0.0, 0), (0.3, 0), (0.4, 1), (0.0, 1), (0.1, 0), (0.0, 0)]):
        if anew:
            odometer.reconnected()
        odometer.pose(x, 0.0, 0.0, 0.1 * k)
        found.append(odometer.x)
    assert found == pytest.approx([0.0, 0.3, 0.4, 0.4, 0.5, 0.4])


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
    ("address", "device", "server"),
    [
        ("khepera4://h", {}, None),
        ("khepera4://h?server=fork", {}, "fork"),
        ("khepera4://h", ONCE, "2023-01-07"),
        ("khepera4://h?server=fork", {"server": "fork"}, "fork"),
        ("kteam://h:1", KTEAM, "kteam"),
    ],
)
def test_server_is_named_in_address_or_table(address, device, server):
    assert KheperaAddress.parse("R0", address).server_of("R0", protocol.Khepera4Settings(**device)) == server


@pytest.mark.parametrize(
    ("address", "device"),
    [("khepera4://127.0.0.1?server=fork", PARK), ("kteam://127.0.0.1:1", {"server": "fork"}),
     ("khepera4://127.0.0.1", KTEAM)],
)  # fmt: skip
def test_address_and_table_must_not_contradict_one_another(address, device):
    for _ in range(2):  # a refused body claims no device
        with pytest.raises(BodyError, match=r"R0: 127\.0\.0\.1:.*: device\.server is "):
            KheperaBody(request("khepera4", [address], device=device)).open()


@pytest.mark.parametrize("failure", mostly_slow([AssertionError, MemoryError, UnicodeError, StopIteration], 4))
def test_link_outlives_failures_of_any_kind(failure):
    tried = []

    class Broken(KheperaAddress):
        def connect(self):
            tried.append(link.trouble)
            if len(tried) == 2:
                link.end()
            raise failure("broken")

    link = link_of(Broken(False, "127.0.0.1", 50000, "", None))
    link.start()
    link.join()
    assert f"{failure.__name__}: broken" in tried[1]


def test_command_is_as_old_as_its_state():
    link = link_of()
    link.drive(0.1, 0.2, uptime())
    assert link.current_twist() == (0.1, 0.2, pytest.approx(uptime() + FRESH_S, abs=0.4))
    link.drive(0.1, 0.2, uptime() - FRESH_S - 3.0)  # read before a suspension, commanded after it
    assert link.current_twist()[:2] == (0.0, 0.0)


def test_a_stop_that_is_not_answered_is_said():
    link = link_of()
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


# ---------------------------------------------------------------------- with twins


@pytest.mark.system
def test_nobody_there_is_said_with_the_remedy():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    begin = time.monotonic()
    said = refusal(request("khepera4", [f"khepera4://127.0.0.1:{port}", "kteam:///dev/ttyNONE"]), **IMPATIENT)
    assert 1.0 < time.monotonic() - begin < 2.5
    assert OPEN_S < 5.0
    assert f"R0: 127.0.0.1:{port}: Connection refused; start the server on the robot" in said
    assert "R1: /dev/ttyNONE: No such file or directory; is the line plugged in" in said


@pytest.mark.system
@pytest.mark.parametrize(
    ("speaks", "bearings"), [((PARK, PARK), 0), ((KTEAM, KTEAM), 13), ((ONCE | {"ranges": True}, PARK), 5)]
)
def test_robots_drive_to_their_goals(served, speaks, bearings):
    rows = replace(request("khepera4", ["khepera4-twin"] * 2, yaw=0.5), device=speaks)
    twins, goals = served(rows), np.array([[0.25, 0.1], [-0.2, 0.95]])
    with opened(reached(rows, twins.addresses), *goals) as driver:
        driver.until(lambda: np.abs(twins.truth()[0][:, :2] - goals).max() < 0.012)
        driver.decide = None
        driver.body.land(range(2))
        driver.until(lambda: np.abs(driver.state.velocity).max() < 0.01)
        state, (position, yaw) = driver.state, twins.truth()
        assert [driver.body.inspect(row).firmware for row in (0, 1)] == [f"server {each['server']}" for each in speaks]
        if bearings:
            driver.until(lambda: driver.state.scan[0] is not None)
            assert len(driver.state.scan[0].bearing) == bearings
            assert np.isnan(driver.state.scan[0].distance).all()
    assert state.position == pytest.approx(position, abs=0.01)
    assert state.yaw == pytest.approx(yaw, abs=0.03)
    assert not state.flying.any()
    assert state.note == ("", "")
    assert (state.battery > 0.98).all() if speaks[0] == KTEAM else np.isnan(state.battery).all()
    assert (np.abs(twins.truth()[0] - position) < 1e-3).all()


@pytest.mark.system
def test_link_gap_stops_robot_and_keeps_the_connection(served):
    """A server that accepts one client in its life, silent for 0.7 s: what is sent meanwhile comes glued together."""
    rows = replace(ONE, device=(ONCE,))
    twins = served(rows, silent_from_s=2.0, silent_for_s=0.7)
    with opened(reached(rows, twins.addresses)) as driver:
        driver.decide = constant(0.1)
        driver.until(lambda: driver.state.note[0])
        assert "no answer to p; it gets stops until it answers" in driver.state.note[0]
        driver.decide = None
        driver.until(lambda: not driver.state.note[0])
        stood = twins.truth()[0][0, 0]
        driver.decide = toward(KHEPERA4, [(stood + 0.3, 0.0, 0.0)])
        driver.until(lambda: twins.truth()[0][0, 0] > stood + 0.2)


@pytest.mark.parametrize(
    ("speaks", "question", "comes_back"), mostly_slow([(PARK, b"p", True), (ONCE, b"p", False), (KTEAM, b"R", True)], 3)
)
def test_garbled_answer_stops_the_robot(served, speaks, question, comes_back):
    """Noise on the line: the robot stands, whether or not its server accepts another client; then it goes on."""
    rows = replace(ONE, device=(speaks,))
    twins = served(rows)
    (server,) = twins.device.servers
    answered = server._answer

    def garbled(received, t):
        if not received.startswith(question):
            return answered(received, t)
        server._answer = answered
        return b"?\r\n"

    body = KheperaBody(reached(rows, twins.addresses), first_answer_s=0.5)
    body.open()
    with closing(body):
        driver = Driver(body, constant(0.1))
        driver.until(lambda: server.robot.model.velocity[0] > 0.05)
        server._answer = garbled
        driver.until(lambda: driver.state.note[0], "the fault is noted")
        driver.until(lambda: server.robot.twist == (0.0, 0.0), "it stands")
        if comes_back:
            driver.until(lambda: not driver.state.note[0] and server.robot.model.velocity[0] > 0.05, "it goes on")


@pytest.mark.system
def test_external_position_replaces_odometry(served):
    rows = request("khepera4", ["khepera4-twin"], external=True, start=[[0.3, 0.0, 0.0]])
    twins = served(rows)
    lied = request("khepera4", twins.addresses, external=True, start=[[9.0, 9.0, 0.0]], yaw=2.0)
    with opened(lied, (0.5, 0.1)) as driver:
        assert np.isnan(driver.tick().position).all()
        driver.truth = twins.truth
        driver.until(lambda: np.abs(twins.truth()[0][0, :2] - [0.5, 0.1]).max() < 0.008)
        assert driver.state.position[0] == pytest.approx(twins.truth()[0][0], abs=0.004)


@pytest.mark.system
def test_fault_of_one_robot_leaves_others_driving(served):
    kteam = replace(ONE, device=(KTEAM,))
    good, killed, silent, empty = (
        served(ONE), served(ONE), served(kteam, silent_from_s=1.0), served(kteam, battery=0.03)
    )  # fmt: skip
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        absent = f"khepera4://127.0.0.1:{free.getsockname()[1]}"
    addresses = [*(each.addresses[0] for each in (good, killed, silent, empty)), absent]
    begin = time.monotonic()
    with opened(request("khepera4", addresses, start=[(0.0, 0.0, 0.0)] * 5), *[(0.3, 0.0)] * 5) as driver:
        assert time.monotonic() - begin < 5.0
        driver.until(lambda: killed.truth()[0][0, 0] > 0.02)
        killed.kill()
        driver.until(lambda: driver.state.note[1] and driver.t - driver.state.time[1] > 0.5)
        driver.until(lambda: driver.state.note[2])
        driver.until(lambda: driver.t - driver.state.time[2] > 0.5)
        notes = driver.state.note
        driver.until(lambda: abs(good.truth()[0][0, 0] - 0.3) < 0.008 and not driver.state.note[0])
        assert driver.slowest < 0.5
    assert notes[1].startswith("silent for")
    assert any(text in notes[1] for text in ("Connection refused", "closed the connection", "reset by peer"))
    assert "no answer to" in notes[2]
    assert notes[3] == "battery at 3%: too low to drive"
    assert empty.truth()[0][0, 0] == 0.0
    assert "Connection refused; start the server" in notes[4]
    assert np.isnan(driver.state.position[4]).all()


@pytest.mark.mechanism("Khepera IV bridge: link loss")
@pytest.mark.system
def test_lost_link_comes_back_and_goes_on(served):
    first = served(ONE)
    with opened(reached(ONE, first.addresses), (0.5, 0.0)) as driver:
        driver.until(lambda: first.truth()[0][0, 0] > 0.1)
        first.kill()
        driver.until(lambda: driver.state.note[0])
        stood = driver.state.position[0, 0]
        place = first.addresses[0].replace("khepera4://", "khepera4-twin://")
        second = served(request("khepera4", [place], start=[[stood, 0.0, 0.0]]))
        driver.until(lambda: not driver.state.note[0])
        driver.until(lambda: abs(second.truth()[0][0, 0] - 0.5) < 0.008)
        assert driver.state.position[0, 0] == pytest.approx(second.truth()[0][0, 0], abs=0.004)


@pytest.mark.system
@pytest.mark.parametrize(
    "speaks", [pytest.param(PARK, marks=pytest.mark.mechanism("Khepera IV bridge: no more setpoints")), KTEAM]
)
def test_wheels_stop_without_setpoints_and_at_closing(served, speaks):
    rows = replace(ONE, device=(speaks,))
    twins = served(rows)
    with opened(reached(rows, twins.addresses)) as driver:
        driver.tick()
        driver.body.command([(0.2, 0.0, 0.0, 0.0)])
        driver.until(lambda: driver.state.velocity[0, 0] > 0.1)
        driver.until(lambda: driver.state.velocity[0, 0] < 0.005)  # the setpoint is not given again
        went = twins.truth()[0][0, 0]
        assert 0.09 < went < 0.5  # half a second, the time to be heard, the time to stop
        driver.body.command([(np.nan, 0.0, 0.0, 0.0)])
        driver.body.command([(0.2, 0.0, 0.0, 0.0)])
        driver.until(lambda: twins.truth()[0][0, 0] > went + 0.02)

    def stands():
        before = twins.truth()[0][0, 0]
        threading.Event().wait(0.1)
        return twins.truth()[0][0, 0] == before

    until(stands, "it stands")


@pytest.mark.system
@pytest.mark.parametrize("speaks", [PARK, KTEAM])
def test_second_client_learns_that_another_holds_server(served, speaks, monkeypatch, tmp_path):
    rows = replace(ONE, device=(speaks,))
    reachable = reached(rows, served(rows).addresses)
    with opened(reachable) as driver:
        monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path))  # another user's, or another computer's
        assert re.search("no answer to .*another program may hold it", refusal(reachable, **IMPATIENT))
        assert driver.tick().note == ("",)


@pytest.mark.system
def test_the_wrong_protocol_is_named(served):
    park, kteam, older = (served(replace(ONE, device=(each,))).addresses[0] for each in (PARK, KTEAM, ONCE))
    crossed = [park.replace("khepera4", "kteam"), kteam.replace("kteam", "khepera4")]
    said = refusal(request("khepera4", crossed), **IMPATIENT)
    assert said.count("the robot uses the other protocol") == 2
    said = refusal(request("khepera4", [older]), **IMPATIENT)
    assert re.search("answers p with .* write the one that runs there, such as device = { server", said)
    said = refusal(request("khepera4", [older], device=ONCE), **IMPATIENT)
    assert "no answer to p; a server of 2023 serves one client in its life: restart it" in said


# ---------------------------------------------------------------------- with servers made by hand


@contextmanager
def recording(*, lives=1, hangs_up=lambda _reads: False):
    """A server: yields its address, and for each of its clients a list of the texts it has read, and when."""
    answers = {"p": b"0.0000,0.0000", "get_data": b"30,1000,2000,0,100"}
    clients = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            while len(clients) < lives:
                wire, _ = listener.accept()
                reads = []
                clients.append(reads)
                with wire:
                    while not hangs_up(clients) and (data := wire.recv(255).decode()):
                        reads.append((data, time.monotonic()))
                        wire.sendall(answers.get(data, b""))

        server = threading.Thread(target=serve, daemon=True)
        server.start()
        yield f"khepera4://127.0.0.1:{listener.getsockname()[1]}?server=2023-01-07", clients
        server.join(2.0)


@pytest.mark.system
def test_park_never_gets_two_commands_at_once():
    with (
        recording() as (place, clients),
        opened(request("khepera4", [place], device={"ranges": True}), (1.0, 0.0)) as driver,
    ):
        driver.until(lambda: len(clients[0]) > 60)
        scan = driver.state.scan[0]
    reads = [text for text, _ in clients[0]]
    assert {text.split()[0] for text in reads} == {"d", "p", "get_data", "stop"}
    assert all(len(text.split()) == 3 for text in reads if text[0] == "d")
    assert reads[0] == "stop"
    assert reads[-4:] == ["stop"] * 3 + ["p"]  # its answer shows that the stops were read
    assert scan.distance == pytest.approx([0.37, np.nan, np.nan, 0.32, 1.07], nan_ok=True)
    assert scan.bearing[0] == pytest.approx(np.pi / 2)


@pytest.mark.system
def test_wheels_with_link_broken_at_end_are_stopped():
    """A server that hangs up when it is told to stop, once."""

    def hangs_up(clients):
        texts = [text for text, _ in clients[-1]]
        return len(clients) == 1 and any(text[0] == "d" for text in texts) and texts[-1] == "stop"

    with (
        recording(lives=2, hangs_up=hangs_up) as (place, clients),
        opened(request("khepera4", [place]), (1.0, 0.0)) as driver,
    ):
        driver.until(lambda: any(text[0] == "d" for text, _ in clients[0]))
    assert len(clients) == 2
    assert [text for text, _ in clients[1]][-2:] == ["stop", "p"]


DRIVING = """
import sys, time
from bridges.khepera4.body import KheperaBody
from tests.bridges.driver import Driver
from tests.requests import request

change = float(sys.argv[2])


def decide(states):
    return [(0.10 if time.monotonic() < change else 0.05, 0.0, 0.0, 0.0)]


body = KheperaBody(request("khepera4", [sys.argv[1]]))
body.open()
driver = Driver(body, decide, fast=5.0)
while True:
    driver.tick()
"""


@pytest.mark.system
def test_process_woken_from_suspension_sends_only_a_stop():
    """The process drives at 0.10 m/s until it is suspended, and at 0.05 m/s afterwards."""
    with recording() as (place, clients):
        begin = time.monotonic()
        child = subprocess.Popen([sys.executable, "-c", DRIVING, place, str(begin + 8.0)])

        def suspend(over, then):
            os.kill(child.pid, signal.SIGSTOP)
            until(over, "the suspension is over")
            woke, known = time.monotonic(), len(clients[0])
            os.kill(child.pid, signal.SIGCONT)
            until(lambda: then(after := clients[0][known:]) and after[-1][1] > woke, "it goes on")
            return [text for text, at in clients[0][known:] if at > woke]

        try:
            until(lambda: clients and any(text.startswith("d 10.0") for text, _ in clients[0]), "it drives")
            for _ in range(5):  # at any point of its loop
                over = time.monotonic() + 0.7
                suspend(lambda over=over: time.monotonic() > over, lambda reads: len(reads) > 3)
            after = suspend(
                lambda: time.monotonic() > begin + 8.5, lambda reads: any(text.startswith("d 5.0") for text, _ in reads)
            )
        finally:
            child.kill()
            child.wait()
    assert after
    assert not [text for text in after if text.startswith("d 10.0")]


@pytest.fixture
def line():
    """A pseudo terminal: our end, and the address of the other."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    yield ours, f"kteam://{os.ttyname(theirs)}"
    os.close(ours)
    os.close(theirs)


@pytest.mark.system
def test_serial_line_in_use_is_left_alone(line):
    ours, place = line
    address = KheperaAddress.parse("KH01", place)
    first, link = address.connect(), link_of(address)
    link.start()
    try:
        until(lambda: "another process has this line; end it first" in link.trouble, "it is named")
        assert not select.select([ours], [], [], 0.0)[0]  # nothing was said on it
    finally:
        link.end()
        first.close()
    address.connect().close()  # free again


def test_kteam_over_a_serial_line(line):
    """The twin's side of the protocol at its other end."""
    ours, place = line
    device = KheperaDevice(DeviceRequest(replace(ONE, device=(KTEAM,)), Faults()))
    ending, heard = threading.Event(), []

    def serve():
        begun = b""
        while not ending.is_set():
            if select.select([ours], [], [], 0.02)[0]:
                *lines, begun = (begun + os.read(ours, 255)).split(b"\r")
                for text in map(bytes.decode, lines):
                    heard.append(text)
                    os.write(ours, f"{answer_kteam(device.servers[0].robot, text)}\r\n".encode())

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    try:
        with opened(request("khepera4", [place])) as driver:
            driver.tick()
            driver.body.command([(0.1, 0.5, 0.0, 0.0)])
            driver.until(lambda: "D,109,186" in heard)
            assert driver.state.note == ("",)
            assert driver.state.battery[0] == 1.0
    finally:
        ending.set()
        server.join()
        device.close()
    assert heard[:3] == ["D,0,0", "B", "U,31"]
    assert heard[-4:] == ["D,0,0"] * 3 + ["R"]
