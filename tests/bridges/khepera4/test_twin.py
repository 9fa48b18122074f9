"""The Khepera twin by its two protocols: a client of bare sockets, and the device's own time."""

import math
import select
import socket
from contextlib import ExitStack, closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import BodyError, Disturbance
from bridges.khepera4 import protocol
from bridges.khepera4.twin import KheperaDevice
from tests.requests import request
from twins.device import DeviceRequest, Faults

DT, NO_FAULTS = 0.01, Faults()


class Conversation:
    """A client of one robot that lets its time pass tick by tick."""

    def __init__(self, server, *, faults=NO_FAULTS, **parts):
        rows = request("khepera4", ["khepera4-twin"], device={"server": server}, **parts)
        self.device = KheperaDevice(DeviceRequest(rows, faults))
        self.clients, self.tick = [], 0
        self.client = self.connect()

    def connect(self):
        host, port = self.device.addresses[0].partition("://")[2].split(":")
        self.clients.append(socket.create_connection((host, int(port)), 1.0))
        self.clients[-1].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.serve()
        return self.clients[-1]

    def close(self):
        for client in self.clients:
            client.close()
        self.device.close()

    def serve(self):
        for wire in select.select(self.device.sockets(), [], [], 0.05)[0]:
            self.device.serve(wire, self.tick * DT)

    def say(self, data, client=None):
        (client or self.client).sendall(data)
        self.serve()

    def heard(self, client=None):
        client = client or self.client
        return client.recv(1024).decode() if select.select([client], [], [], 0.0)[0] else None

    def ask(self, data):
        self.say(data)
        return self.heard()

    def values(self, data=b"p"):
        return [float(word) for word in self.ask(data).split(",") if not word.isalpha()]

    def after(self, seconds):
        for _ in range(round(seconds / DT)):
            self.tick += 1
            self.device.advance(self.tick * DT)
        return self

    @property
    def truth(self):
        position, yaw = self.device.truth()
        return [*position[0, :2].tolist(), float(yaw[0])]

    def speed(self):
        """Speed over the floor [m/s], from now on."""
        return math.dist(self.truth[:2], self.after(0.5).truth[:2]) / 0.5


@pytest.fixture
def talk():
    with ExitStack() as made:
        yield lambda server, **parts: made.enter_context(closing(Conversation(server, **parts)))


def test_server_of_2025_drives_and_reports_in_centimetres(talk):
    robot = talk("2025-05", start=[[0.5, -0.2, 0.0]], yaw=np.pi / 2)
    assert robot.ask(b"p") == "0.00,0.00,0.00"
    robot.say(b"d 10.0 0.0")
    assert robot.after(2.0).truth == pytest.approx([0.5, 0.0, np.pi / 2], abs=0.004)
    assert robot.values() == pytest.approx([0.2, 0.0, 0.0], abs=0.006)
    robot.say(b"d 0.0 0.5")
    assert robot.after(1.0).values()[2] == pytest.approx(0.5, abs=0.04)  # wheels turn in whole units
    robot.say(b"stop")
    assert robot.after(0.2).speed() == 0.0


@pytest.mark.parametrize(("server", "words"), [("2023-01-07", b"d 5 0"), ("fork", b"d 5 0"), ("kteam", b"D,74,74\r")])
def test_no_watchdog_and_clients_that_leave(talk, server, words):
    robot = talk(server)
    robot.say(words)
    assert robot.after(4.0).speed() > 0.03
    question = b"R\r" if server == "kteam" else b"p"
    second = robot.connect()
    robot.say(question, second)
    assert robot.heard(second) is None
    assert robot.ask(question) is not None
    robot.client.close()
    for _ in range(3):  # the first goes, the second is let in, and heard
        robot.serve()
    assert (robot.heard(second) is None) == server.startswith("2023")
    assert (robot.after(0.2).speed() > 0.03) == (server not in {"2025-05", "fork"})


@pytest.mark.parametrize(
    ("server", "obeys", "drives", "answers"),
    [("2023-01-07", True, False, True), ("2023-01-15", False, True, True), ("2023-04-10", False, True, False),
     ("2025-05", True, False, False), ("fork", True, True, True)],
)  # fmt: skip
def test_what_servers_do_with_speeds_and_polls(talk, server, obeys, drives, answers):
    robot = talk(server)
    assert (robot.ask(b"get_data") == "1000,1000,1000,1000,1000") == answers
    assert (robot.after(1.5).speed() > 0.0) == drives  # later servers take the poll of ranges as a goal
    robot.say(b"stop")
    assert (robot.after(2.0).speed() > 0.0) == drives  # the next turn of its loop drives again
    robot = talk(server)
    robot.say(b"d 5 0")
    assert (robot.after(0.5).speed() > 0.04) == obeys


def test_park_loses_what_is_glued_to_a_command(talk):
    robot = talk("2023-01-07")
    robot.say(b"d 5.0 0.1")
    robot.after(1.0).ask(b"p")
    assert robot.after(1.0).values() == pytest.approx([0.05, 0.1], abs=0.006)  # since the last question
    robot.say(b"d 10.0 0.0stop")
    assert robot.after(0.5).speed() > 0.08


def test_goal_is_reached_by_2023_04_10_controller(talk):
    robot = talk("2023-04-10", start=[[0.3, 0.0, 0.0]])
    robot.say(b"i 1.0 0.5 1.0")
    assert (robot.ask(b"p"), robot.ask(b"t")) == ("1.0000,0.5000,1.0000", "0.0000,1.0000")
    robot.say(b"g 1.0 0.9")
    for _ in range(400):  # slower and slower: v falls with the square of Δy
        robot.ask(b"p")
        robot.after(0.05)
    assert robot.values()[:2] == pytest.approx([1.0, 0.9], abs=0.06)
    # its frame is turned by 1 rad against the world
    assert robot.truth[:2] == pytest.approx([0.3 + 0.4 * math.sin(1.0), 0.4 * math.cos(1.0)], abs=0.06)


@pytest.mark.parametrize("server", ["2023-01-15", "fork"])
def test_way_counts_from_the_last_command(talk, server):
    """Of 40 ms at 0.1 m/s 30 are reported: those before the speed command, not the 10 behind it."""
    robot = talk(server)
    drive = b"d 10 0" if server == "fork" else b"g 1000 0"
    if server == "2023-01-15":
        robot.say(b"i 999 0")  # one metre before its goal: 10 cm/s
    told = []
    for _ in range(25):
        robot.say(drive)
        robot.after(0.01)
        told.append(robot.values()[0])
        robot.after(0.03)
    assert told[5:] == pytest.approx([0.003] * 20, abs=0.0005)
    assert robot.truth[0] == pytest.approx(0.1, abs=0.01)


PARK = (b"d", b"d fast", b"i", b"x", b"\xff\x00", b"d nan nan", b"d 1e999 0"), None
KTEAM = (b"Q\r", b"D,1\r", b"D,a,b\r", b"V,99\r", b"\xff\r", b"d,1,1\r"), "$\r\n"


@pytest.mark.parametrize(("server", "nonsense"), [("2025-05", PARK), ("kteam", KTEAM)])
def test_nonsense_is_ignored_or_answered_by_a_dollar(talk, server, nonsense):
    robot, (words, answer) = talk(server), nonsense
    assert {word: robot.ask(word) for word in words} == dict.fromkeys(words, answer)
    assert robot.after(0.5).speed() == 0.0


def test_kteam_speaks_in_lines_units_and_pulses(talk):
    robot = talk("kteam")
    asked = (b"D,0", b",0\rE", b"\r\nB\r\n", b"D,147,147\r")
    assert [*map(robot.ask, asked)] == [None, "d\r\n", "e,0,0\r\nb,C,4\r\n", "d\r\n"]
    assert robot.after(2.0).ask(b"E\r") == "e,147,147\r\n"
    assert robot.truth[0] == pytest.approx(0.1994, abs=0.004)
    left, right = robot.values(b"R\r")
    assert left == right == pytest.approx(robot.truth[0] / 6.781e-6, abs=1.0)
    assert [*map(robot.ask, (b"I\r", b"R\r", b"D,-50,50\r"))] == ["i\r\n", "r,0,0\r\n", "d\r\n"]
    assert robot.after(1.0).truth[2] == pytest.approx(100 * 0.6781e-3 / 0.1054, abs=0.025)
    ranges = ["g,1000,1000,1000,1000,1000\r\n", "u\r\n", "g,2000,2000,1000,2000,2000\r\n"]
    assert [*map(robot.ask, (b"G\r", b"U,4\r", b"G\r"))] == ranges
    assert robot.ask(b"N\r").count(",") == 12
    assert robot.ask(b"V,5\r") == "v,100\r\n"
    robot.ask(b"D,99999,99999\r")
    assert robot.after(2.0).ask(b"E\r") == "e,1200,1200\r\n"


def test_silence_and_delay(talk):
    robot = talk("2023-01-07", faults=Faults(silent_from_s=1.0, silent_for_s=1.0, delay_s=0.05))
    assert robot.ask(b"p") is None
    assert robot.after(0.05).heard() is not None
    robot.say(b"d 10 0")
    robot.after(1.0)
    robot.say(b"p")
    robot.say(b"stop")
    assert robot.after(0.5).heard() is None
    assert robot.truth[0] > 0.12  # it drives on, for it heard nothing
    robot.after(0.6).serve()  # both come at once, and it reads the first
    assert robot.after(0.06).heard() is not None
    assert robot.speed() > 0.09
    robot.say(b"stop")
    assert robot.after(0.2).speed() == 0.0


def test_a_battery_that_ends_stops_and_silences_it(talk):
    robot = talk("kteam", faults=Faults(battery=0.5, drain=1800.0))
    robot.say(b"D,100,100\r")
    assert robot.after(4.0).ask(b"V,5\r") == "d\r\nv,10\r\n"
    assert robot.after(2.0).speed() == 0.0
    assert robot.ask(b"V,5\r") is None


def test_odometry_drifts_and_commands_lag_as_specified(talk):
    robot = talk("2025-05", disturbance=Disturbance(odometry_drift=0.02, latency_s=0.2))
    robot.say(b"d 20 0")
    assert robot.after(0.2).truth[0] == 0.0
    error = np.subtract(robot.after(5.0).values()[:2], robot.truth[:2])
    assert 0.001 < np.abs(error).max() < 0.1  # 0.02 m per root metre along its nose, on one metre


def test_addresses_that_cannot_be_had(talk):
    held = talk("2023-01-07").device.addresses[0].removeprefix("khepera4://")
    for address, device, why in (
        (f"khepera4-twin://{held}", {}, "name another address"),
        ("khepera4-twin://192.168.0.21", {}, "loopback"),
        ("khepera4-twin://127.0.0.1:99999", {}, "name another address"),
        ("khepera4-twin", {"server": "morse"}, r"R0: device: .*server"),
    ):
        with pytest.raises(BodyError, match=why):
            KheperaDevice(DeviceRequest(request("khepera4", [address], device=device), NO_FAULTS))


@given(st.floats(-0.27, 0.27), st.floats(-2.0, 2.0))
def test_units_and_their_inverse(v, turn):
    assert protocol.twist(*protocol.units(v, turn)) == pytest.approx((v, turn), abs=0.6781e-3 / 0.1054)
    left, right = protocol.units(2.0, 4.0)
    assert max(left, right) == protocol.FASTEST
    v, turn = protocol.twist(left, right)
    assert turn / v == pytest.approx(2.0, rel=0.002)  # a curve too fast for the wheels stays that curve


def test_ranges_in_metres_from_the_centre():
    sound = [protocol.sound_distance(each) for each in (0.0, 25.0, 250.0, 1000.0, 2000.0)]
    assert sound == pytest.approx([0.32, 0.32, 2.57, np.nan, np.nan], nan_ok=True)
    light = [protocol.light_distance(each) for each in (1023.0, 1000.0, 250.0, 101.0, 100.0, 0.0)]
    assert light == pytest.approx([0.07, 0.07, 0.1625, 0.2686, np.nan, np.nan], abs=0.001, nan_ok=True)
