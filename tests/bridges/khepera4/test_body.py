"""The Khepera bridge: odometry by numbers, and real sockets between bridge and twin."""

import os
import re
import select
import socket
import threading
import tty
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import FRESH_S, BodyError
from agents.clock import uptime
from bridges.khepera4 import protocol
from bridges.khepera4.body import KheperaBody
from bridges.khepera4.kind import KHEPERA4
from bridges.khepera4.link import Khepera4Link, KheperaAddress, KheperaOdometry
from bridges.khepera4.odometry import Odometer
from bridges.khepera4.twin import KheperaDevice, answer_kteam
from tests.bridges.driver import Driver, constant, toward
from tests.cases import mostly_slow
from tests.requests import request
from tests.twins.loopback import Served, reached
from tests.waiting import PATIENCE_S
from twins.device import DeviceRequest, Faults

PARK, KTEAM, ONCE = ({"server": name} for name in ("2025-05", "kteam", "2023-01-07"))
ONE = request("khepera4", ["khepera4-twin"])


@pytest.fixture
def served():
    with ExitStack() as stack:
        yield lambda rows, **faults: stack.enter_context(Served(KheperaDevice, rows, **faults))


@contextmanager
def opened(rows, *goals, open_s=PATIENCE_S):
    """A process that drives a body toward goals (x, y) [m]; its robots have `open_s` to answer."""
    body = KheperaBody(rows, open_s, open_s)
    body.open()
    with closing(body):
        yield Driver(body, toward(KHEPERA4, [(x, y, 0.0) for x, y in goals]) if goals else None)


def refusal(*addresses, **device):
    with pytest.raises(BodyError) as caught:
        KheperaBody(request("khepera4", addresses, device=device), open_s=1.0, first_answer_s=0.5).open()
    return str(caught.value)


def link_of(where=None):
    """The link of one robot, not begun."""
    where = where or KheperaAddress.parse("K", "khepera4://127.0.0.1")
    return Khepera4Link("K", where, protocol.Khepera4Settings(), (0.0, 0.0, 0.0))


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
    for x, y in ((7.0, 8.0), (7.0 + np.cos(1.0), 8.0 + np.sin(1.0))):  # one metre along its nose
        begin = (odometer.x, odometer.y, odometer.yaw)
        odometer.pose(x, y, 1.0, 0.0 if x == 7.0 else 1.0)
    assert (begin, (odometer.x, odometer.y)) == ((0.5, 0.0, np.pi / 2), pytest.approx((0.5, 1.0)))
    driven = Odometer(0.0, 0.0, np.pi / 2)
    for step in range(26):
        driven.steps(0.008, 0.0, 0.04 * step)
    assert driven.velocity == pytest.approx((0.0, 0.2), abs=0.002)  # after a tenth of a second


def test_robot_switched_on_again_continues_where_it_was():
    odometer, found = Odometer(0.0, 0.0, 0.0), []
    # its server lived on, and it rolled a little; its server is new; it backs up over its zero, without doubt
    for k, (x, anew) in enumerate([(0.0, 0), (0.3, 0), (0.4, 1), (0.004, 1), (0.1, 0), (0.0, 0)]):
        if anew:
            odometer.reconnected()
        odometer.pose(x, 0.0, 0.0, 0.1 * k)
        found.append(odometer.x)
    assert found == pytest.approx([0.0, 0.3, 0.4, 0.4, 0.496, 0.396])


@pytest.mark.parametrize(
    ("address", "device", "expected", "server"),
    [
        ("khepera4://192.168.0.21", {}, (False, "192.168.0.21", 50000, "", None), None),
        ("khepera4://kh1.lab:1234", ONCE, (False, "kh1.lab", 1234, "", None), "2023-01-07"),
        ("kteam://10.0.0.3:2000", KTEAM, (True, "10.0.0.3", 2000, "", None), "kteam"),
        ("kteam:///dev/ttyS0", {}, (True, "", 0, "/dev/ttyS0", None), None),
        ("khepera4://kh1?server=fork", {}, (False, "kh1", 50000, "", "fork"), "fork"),
        ("khepera4://kh1?server=fork", {"server": "fork"}, (False, "kh1", 50000, "", "fork"), "fork"),
    ],
)
def test_server_is_named_in_address_or_table(address, device, expected, server):
    parsed = KheperaAddress.parse("K", address)
    assert parsed == KheperaAddress(*expected)
    assert parsed.server_of("R0", protocol.Khepera4Settings(**device)) == server


def test_address_and_table_must_not_contradict_one_another():
    for address, server in (("khepera4://127.0.0.1?server=fork", "2025-05"), ("khepera4://127.0.0.1", "kteam")):
        for _ in range(2):  # a refused body claims no device
            assert re.match(r"R0: device\.server is .*, but 127\.0\.0\.1:", refusal(address, server=server))


@pytest.mark.parametrize("failure", mostly_slow([AssertionError, StopIteration], 2))
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

    def unanswered(t, v=None):
        """Whether it is now; the robot drives at this speed [m/s]."""
        if v is not None:
            link.odometry = KheperaOdometry(t, 0.0, 0.0, 0.0, (v, 0.0))
        return link.unanswered(t)

    link.drive(0.2, 0.0, 0.0)
    unanswered(100.0, 0.2)
    link.halt(100.0)
    link.halt(101.0)  # again, by the watchdog
    assert [unanswered(102.0), unanswered(103.0), unanswered(103.0, 0.0)] == [False, True, False]
    link.drive(0.2, 0.0, 99.0)
    assert link.setpoint[:2] == (0.0, 0.0), "decided before the stop"
    link.drive(0.2, 0.0, 104.0)
    assert not unanswered(110.0, 0.2)


@pytest.mark.system
@pytest.mark.parametrize(("speaks", "bearings"), [((KTEAM, KTEAM), 13), ((ONCE | {"ranges": True}, PARK), 5)])
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
        driver.until(lambda: driver.state.scan[0] is not None)
        scan = driver.state.scan[0]
    assert (len(scan.bearing), np.isnan(scan.distance).all()) == (bearings, True)
    assert (state.position, state.yaw) == (pytest.approx(position, abs=0.01), pytest.approx(yaw, abs=0.03))
    assert (state.note, state.flying.any()) == (("", ""), False)
    assert (state.battery > 0.98).all() if speaks[0] == KTEAM else np.isnan(state.battery).all()
    assert (np.abs(twins.truth()[0] - position) < 1e-3).all()


@pytest.mark.parametrize(
    ("speaks", "question", "comes_back"), mostly_slow([(PARK, b"p", True), (ONCE, b"p", False), (KTEAM, b"R", True)], 3)
)
def test_garbled_answer_stops_the_robot(served, speaks, question, comes_back):
    """Noise on the line: the robot stands, whether or not its server accepts another client; then it goes on."""
    twins = served(rows := replace(ONE, device=(speaks,)))
    (server,) = twins.device.servers
    answered, model = server._answer, server.robot.model

    def garbled(received, t):
        return b"?\r\n" if received.startswith(question) else answered(received, t)

    with opened(reached(rows, twins.addresses)) as driver:
        driver.decide = constant(0.1)
        driver.until(lambda: model.velocity[0] > 0.05)
        server._answer = garbled
        driver.until(lambda: driver.state.note[0], "the fault is noted")
        driver.until(lambda: server.robot.twist == (0.0, 0.0), "it stands")
        server._answer = answered
        if comes_back:
            driver.until(lambda: not driver.state.note[0] and model.velocity[0] > 0.05, "it goes on")


@pytest.mark.parametrize("speaks", [PARK, ONCE])
def test_lost_first_question_is_asked_again(served, speaks):
    """A server that reads the stop and the question at once obeys the stop alone."""
    twins = served(rows := replace(ONE, device=(speaks,)))
    (server,) = twins.device.servers
    answered, asked = server._answer, []

    def glued(received, t):
        asked.append(received)
        return b"" if asked.count(b"p") == 1 else answered(received, t)

    server._answer = glued
    with opened(reached(rows, twins.addresses)) as driver:
        driver.decide = constant(0.1)
        driver.until(lambda: server.robot.model.velocity[0] > 0.05)


@pytest.mark.system
def test_external_position_replaces_odometry(served):
    twins = served(request("khepera4", ["khepera4-twin"], external=True, start=[[0.3, 0.0, 0.0]]))
    lied = request("khepera4", twins.addresses, external=True, start=[[9.0, 9.0, 0.0]], yaw=2.0)
    with opened(lied, (0.5, 0.1)) as driver:
        assert np.isnan(driver.tick().position).all()
        driver.truth = twins.truth
        driver.until(lambda: np.abs(twins.truth()[0][0, :2] - [0.5, 0.1]).max() < 0.008)
        driver.until(
            lambda: np.abs(driver.state.position[0] - twins.truth()[0][0]).max() < 0.004, "it knows where it is"
        )


@pytest.mark.system
def test_fault_of_one_robot_leaves_others_driving(served):
    kteam = replace(ONE, device=(KTEAM,))
    good, killed = served(ONE), served(ONE)
    silent, empty = served(kteam, silent_from_s=1.0), served(kteam, battery=0.03)
    addresses = [*(each.addresses[0] for each in (good, killed, silent, empty)), "khepera4://127.0.0.1:9"]
    with opened(request("khepera4", addresses, start=[(0.0, 0.0, 0.0)] * 5), *[(0.3, 0.0)] * 5, open_s=3.0) as driver:
        driver.until(lambda: killed.truth()[0][0, 0] > 0.02)
        killed.kill()
        driver.until(lambda: driver.state.note[1] and (driver.t - driver.state.time[[1, 2]]).min() > 0.5)
        notes = driver.state.note
        driver.until(lambda: abs(good.truth()[0][0, 0] - 0.3) < 0.008 and not driver.state.note[0])
    assert re.match("silent for .*(Connection refused|closed the connection|reset by peer)", notes[1])
    assert "no answer to" in notes[2]
    assert (notes[3], empty.truth()[0][0, 0]) == ("battery at 3%: too low to drive", 0.0)
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
        driver.until(lambda: abs(driver.state.position[0, 0] - second.truth()[0][0, 0]) < 0.004, "it knows where it is")


@pytest.mark.mechanism("Khepera IV bridge: no more setpoints")
@pytest.mark.system
def test_wheels_stop_without_setpoints_and_at_closing(served):
    twins = served(ONE)
    with opened(reached(ONE, twins.addresses)) as driver:
        for v, come in ((0.2, 0.1), (None, 0.005), (0.2, 0.1)):
            driver.decide = constant(v) if v else None  # no setpoint: all are NaN
            driver.until(lambda v=v, come=come: (driver.state.velocity[0, 0] > come) == bool(v))
    assert twins.device.servers[0].robot.twist == (0.0, 0.0)


@pytest.mark.system
def test_the_wrong_protocol_is_named(served, monkeypatch, tmp_path):
    park, kteam, older = (served(replace(ONE, device=(each,))).addresses[0] for each in (PARK, KTEAM, ONCE))
    said = refusal(park.replace("khepera4", "kteam"), kteam.replace("kteam", "khepera4"))
    assert said.count("the robot uses the other protocol") == 2
    said = refusal(older)
    assert re.search("answers p with .* write the one that runs there, such as device = { server", said)
    assert "no answer to p; a server of 2023 serves one client in its life: restart it" in refusal(older, **ONCE)
    with opened(request("khepera4", [park])) as driver:
        monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path))  # another user's, or another computer's
        assert re.search("no answer to .*another program may hold it", refusal(park))
        assert driver.tick().note == ("",)


@contextmanager
def recording():
    """A server that hangs up when it is told to stop, once: its address, and the texts that each client has sent."""
    answers, clients = {"p": b"0.0000,0.0000", "get_data": b"30,1000,2000,0,100"}, []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            drives = data = ""
            while len(clients) < 2:
                wire, _ = listener.accept()
                clients.append([])
                with wire:
                    while not (drives and data == "stop" and len(clients) == 1) and (data := wire.recv(255).decode()):
                        drives = drives or data[0] == "d"
                        clients[-1].append(data)
                        wire.sendall(answers.get(data, b""))

        server = threading.Thread(target=serve, daemon=True)
        server.start()
        yield f"khepera4://127.0.0.1:{listener.getsockname()[1]}?server=2023-01-07", clients
        server.join(PATIENCE_S)


@pytest.mark.system
def test_park_never_gets_two_commands_at_once():
    """And if the link breaks at the end, the stop is sent over a new one."""
    with (
        recording() as (place, clients),
        opened(request("khepera4", [place], device={"ranges": True}), (1.0, 0.0)) as driver,
    ):
        driver.until(lambda: len(clients[0]) > 60)
        scan = driver.state.scan[0]
    assert {text.split()[0] for text in clients[0]} == {"d", "p", "get_data", "stop"}
    assert all(len(text.split()) == 3 for text in clients[0] if text[0] == "d")
    assert (clients[0][0], clients[1][-2:]) == ("stop", ["stop", "p"])
    assert scan.distance == pytest.approx([0.37, np.nan, np.nan, 0.32, 1.07], nan_ok=True)
    assert scan.bearing[0] == pytest.approx(np.pi / 2)


@contextmanager
def serial_twin(heard):
    """Address of a pseudo terminal, with the twin's side of the protocol at its other end."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    ending = threading.Event()

    def serve():
        begun = b""
        while not ending.is_set():
            if select.select([ours], [], [], 0.02)[0]:
                *lines, begun = (begun + os.read(ours, 255)).split(b"\r")
                for text in map(bytes.decode, lines):
                    heard.append(text)
                    os.write(ours, f"{answer_kteam(device.servers[0].robot, text)}\r\n".encode())

    server = threading.Thread(target=serve, daemon=True)
    with closing(KheperaDevice(DeviceRequest(replace(ONE, device=(KTEAM,)), Faults()))) as device:
        server.start()
        yield f"kteam://{os.ttyname(theirs)}"
        ending.set()
        server.join()
    os.close(ours)
    os.close(theirs)


def test_kteam_over_a_serial_line():
    heard = []
    with serial_twin(heard) as place:
        with opened(request("khepera4", [place])) as driver:
            with pytest.raises(OSError, match="another process has this line"):
                KheperaAddress.parse("KH01", place).connect()
            driver.tick()
            driver.body.command([(0.1, 0.5, 0.0, 0.0)])
            driver.until(lambda: "D,109,186" in heard)
            driver.until(lambda: (driver.state.note, driver.state.battery[0]) == (("",), 1.0), "it answers")
        assert (heard[:3], heard[-4:]) == (["D,0,0", "B", "U,31"], ["D,0,0"] * 3 + ["R"])
