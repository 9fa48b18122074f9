"""The Tello twin by its protocol: answers are on the wire, motions are the model's, time is the device's own."""

import select
import socket
from contextlib import ExitStack, closing

import numpy as np
import pytest

from agents.body.interface import BodyError, Disturbance, Jitter
from bridges.tello.twin import TelloDevice
from tests.requests import request
from twins.device import DeviceRequest, Faults

DT, NO_FAULTS = 0.01, Faults()


class Conversation:
    """A client of one or more drones that lets their time pass tick by tick."""

    def __init__(self, rows=1, faults=NO_FAULTS, **parts):
        self.states, self.wire = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for each in (self.states, self.wire):
            each.bind(("127.0.0.1", 0))
        asked = DeviceRequest(request("tello", ["tello-twin"] * rows, **parts), faults)
        self.device = TelloDevice(asked, state_port=self.states.getsockname()[1])
        self.tick = 0

    def close(self):
        for each in (self.wire, self.states, self.device):
            each.close()

    def say(self, text, row=0):
        drone = self.device.sockets()[row]
        self.wire.sendto(text.encode(), drone.getsockname())
        assert select.select([drone], [], [], 1.0)[0]
        self.device.serve(drone, self.tick * DT)

    def heard(self):
        return self.wire.recv(1024).decode() if select.select([self.wire], [], [], 0.0)[0] else None

    def ask(self, text, row=0):
        self.say(text, row)
        return self.heard()

    def wait(self, seconds):
        """Lets time pass; the answers that came, each with when."""
        answers = []
        for _ in range(round(seconds / DT)):
            self.tick += 1
            self.device.advance(self.tick * DT)
            while (answer := self.heard()) is not None:
                answers.append((answer, self.tick * DT))
        return answers

    def answers(self, seconds):
        return [answer for answer, _ in self.wait(seconds)]

    def after(self, seconds):
        self.wait(seconds)
        return self.place()

    def state(self, *fields):
        """The newest state line, as a table, and how many came; or some of its fields."""
        last, count = "", 0
        while select.select([self.states], [], [], 0.0)[0]:
            last, count = self.states.recv(1024).decode(), count + 1
        table = dict(field.split(":") for field in last.strip().strip(";").split(";") if field)
        return [table[field] for field in fields] if fields else (table, count)

    def place(self, row=0):
        return self.device.truth()[0][row]

    def up(self):
        assert self.ask("command") == "ok"
        self.say("takeoff")
        self.wait(8.0)
        return self


@pytest.fixture
def talk():
    with ExitStack() as made:
        yield lambda **parts: made.enter_context(closing(Conversation(**parts)))


@pytest.fixture
def drone(talk):
    return talk().up()


def test_tello_reports_in_sdk_mode(talk):
    drone = talk()
    assert drone.ask("battery?") is None
    drone.wait(1.0)
    assert drone.state()[1] == 0
    assert [drone.ask(text) for text in ("command", "battery?", "sdk?")] == ["ok", "100\r\n", "20\r\n"]
    drone.wait(1.0)
    state, count = drone.state()
    assert count == 10
    assert state | {"bat": "100", "h": "0", "time": "0", "tof": "10", "yaw": "0", "mid": "-2", "x": "-200"} == state
    for command, said in (("mon", ["-1", "-100"]), ("moff", ["-2", "-200"])):
        drone.ask(command)
        drone.wait(0.2)
        assert drone.state("mid", "x") == said


def test_take_off_and_landing_are_answered_when_over(talk):
    drone = talk(faults=Faults(refuse_landing_s=8.0))
    drone.ask("command")
    drone.say("takeoff")
    drone.wait(1.0)
    assert drone.ask("land") == "error"
    [(answer, when)] = drone.wait(7.0)
    assert (answer, 2.0 < when < 6.0) == ("ok", True)  # of the take-off
    assert drone.place()[2] == pytest.approx(0.8, abs=0.01)
    assert drone.ask("land") == "error"
    drone.wait(0.9)
    assert drone.ask("land") == "error"
    drone.wait(0.2)
    drone.say("land")
    begun = drone.tick * DT
    [(answer, when)] = drone.wait(8.0)
    assert (answer, when - begun > 1.0) == ("ok", True)
    assert (drone.place()[2], drone.ask("land")) == (0.0, "error")


def test_sticks_are_body_velocities_until_they_change(talk):
    drone = talk(yaw=np.pi / 2).up()  # its nose points along y
    before = drone.place()
    assert drone.ask("rc 0 50 0 0") is None
    # 0.5 m/s, reached with a time constant of 1/3 s: 4 s less that
    assert drone.after(4.0) - before == pytest.approx([0.0, 0.5 * (4.0 - 1.0 / 3.0), 0.0], abs=0.02)
    drone.say("rc 40 0 -10 0")
    drone.wait(2.1)
    assert drone.state("vgx", "vgy", "vgz") == ["0", "4", "1"]
    drone.say("rc 0 0 0 50")  # clockwise
    drone.wait(1.0)
    assert drone.device.truth()[1][0] == pytest.approx(np.pi / 2 - np.radians(50.0), abs=1e-9)
    drone.wait(0.05)
    assert int(*drone.state("yaw")) == pytest.approx(52, abs=3)


def test_moves_end_where_they_should(drone):
    assert (drone.ask("speed 20"), drone.ask("speed?")) == ("ok", "20.0\r\n")
    for command, way in (("go 50 -40 30 100", (0.5, -0.4, 0.3)), ("ccw 90", (0, 0, 0)), ("left 60", (-0.6, 0, 0))):
        begin = drone.place()
        drone.say(command)
        assert (command, drone.answers(5.0)) == (command, ["ok"])
        assert drone.place() - begin == pytest.approx(way, abs=0.04)
    assert drone.device.truth()[1][0] == pytest.approx(np.pi / 2, abs=0.02)


def test_what_it_refuses(talk):
    drone = talk()
    drone.ask("command")
    for command, answer in (("forward 50", "error Motor stop"), ("stop", "error Motor stop"), (" ", None)):
        assert drone.ask(command) == answer
    drone.up()
    for command, answer in (
        ("forward 10", "out of range"),
        ("forward", "out of range"),
        ("go 10 10 10 50", "error"),
        ("go 501 0 0 50", "out of range"),
        ("cw 361", "out of range"),
        ("takeoff", "error"),
        ("rc 0 0", "error"),
        ("rc a b c d", "error"),
        ("go a 0 0 50", "error"),
        ("go 50 0 0 50 m1", "error No valid marker"),
        ("jump 50 0 0 50 0 m1 m2", "error No valid marker"),
        ("flip x", "error"),
        ("curve 100 0 0 200 0 0 30", "error"),
        ("curve 20 10 0 40 0 0 30", "error"),
        ("curve 100 100 0 200 0 0 90", "out of range"),
        ("EXT led 1 2 3", "unknown command: EXT"),
        ("\xff", "unknown command: ??"),
        ("why?", "unknown command: why?"),
        ("ap name word", "ok,drone will reboot in 3s"),
        ("stop", "ok"),
    ):
        assert (command, drone.ask(command)) == (command, answer)


def test_a_curve_goes_through_its_points(drone):
    begin, centre = drone.place(), drone.place() + np.array([0.0, 1.0, 0.0])
    drone.say("curve 71 29 0 100 100 0 30")  # a quarter of a circle of 1 m, ahead and to the left
    answers = []
    for _ in range(80):
        answers += drone.answers(0.1)
        assert np.linalg.norm((drone.place() - centre)[:2]) == pytest.approx(1.0, abs=0.05)
    assert answers == ["ok"]
    assert drone.place() - begin == pytest.approx([1.0, 1.0, 0.0], abs=0.05)


def test_silence_leaves_the_sticks_then_lands(drone):
    drone.say("rc 0 30 0 0")
    drone.wait(1.0)
    drone.state()
    before = drone.place()
    drone.device.silence(0, 1.0)
    drone.say("rc 0 0 0 0")
    assert drone.after(0.95)[0] - before[0] == pytest.approx(0.285, abs=0.02)
    assert drone.state()[1] == 0
    drone.wait(0.1)
    drone.say("rc 0 0 0 0")
    drone.wait(1.0)
    assert drone.state()[1] > 0
    at = drone.place()
    assert drone.after(13.8) == pytest.approx(at, abs=0.01)  # 14.8 s after the last command
    assert drone.after(1.0)[2] < at[2] - 0.01
    assert drone.after(6.0)[2] == 0.0


def test_a_battery_that_ends_brings_it_down(talk):
    for charge, answer in ((1.0, "ok"), (0.4, "error")):  # a flip needs half of it
        flier = talk(faults=Faults(battery=charge)).up()
        flier.say("flip f")
        assert flier.answers(3.0) == [answer]
    weak = talk(faults=Faults(battery=0.08))
    assert [weak.ask("command"), weak.ask("takeoff")] == ["ok", "error"]
    drained = talk(faults=Faults(battery=0.12, drain=10.0)).up()
    assert drained.after(6.0)[2] == 0.0
    assert 0 <= int(drained.ask("battery?")) < 5


def test_silence_loss_and_delay(talk):
    drone = talk(faults=Faults(silent_from_s=1.0, silent_for_s=1.0, delay_s=0.2))
    drone.say("command")
    assert drone.wait(0.5) == [("ok", pytest.approx(0.2))]
    drone.wait(0.55)
    drone.state()
    assert (drone.ask("battery?"), drone.wait(0.9)) == (None, [])
    assert drone.state()[1] == 1  # what had left before the silence
    drone.wait(0.1)
    drone.say("battery?")
    assert len(drone.wait(0.5)) == 1
    lossy = talk(faults=Faults(loss=0.5))
    answers = [lossy.ask("command") for _ in range(200)]
    assert 30 < answers.count("ok") < 70  # a quarter comes through both ways


def test_disturbance_and_settings_show_in_the_truth(talk):
    jitter = Disturbance(hover_jitter=Jitter(0.02), latency_s=0.1)
    drone = talk(disturbance=jitter, device={"twin_stick_speed": 0.6}).up()
    assert 0.002 < np.std([drone.after(DT)[0] for _ in range(300)]) < 0.06
    drone.say("rc 0 50 0 0")
    before = drone.after(2.0)
    assert drone.after(3.0)[0] - before[0] == pytest.approx(0.9, abs=0.12)


def test_drones_have_addresses_of_their_own(talk):
    pair = talk(rows=2)
    assert len(set(pair.device.addresses)) == 2
    assert pair.ask("command", row=1) == "ok"
    pair.say("takeoff", row=1)
    pair.wait(3.0)
    assert (pair.place(0)[2], pair.place(1)[2] > 0.5) == (0.0, True)
    assert pair.ask("emergency", row=1) == "ok"  # it falls
    pair.wait(0.5)
    assert pair.place(1)[2] == 0.0
    held = pair.device.addresses[0].removeprefix("tello://")
    for address, device, why in (
        (f"tello-twin://{held}", {}, "in use"),
        ("tello-twin://192.168.10.1", {}, "loopback"),
        ("tello-twin://kitchen", {}, "IPv4"),
        ("tello-twin://127.0.0.200:99999", {}, "out of range"),
        ("tello-twin", {"silence": 1}, r"R0: device: .*silence"),
    ):
        with pytest.raises(BodyError, match=why):
            TelloDevice(DeviceRequest(request("tello", [address], device=device), NO_FAULTS))
