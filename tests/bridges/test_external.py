"""The external body: what it says on the network, and what it believes; whether robots fly, by heights alone."""

import json
import re
import threading
import time
from functools import partial
from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest

from agents.body.interface import UNANSWERED, BodyError
from agents.body.limits import LOWEST_DESCENT_M_S
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.vectors import NO_SETPOINT, UNKNOWN
from bridges.external import ExternalBody
from bridges.measured_flight import GROUNDED_S, LANDING_S, MeasuredFlight
from tests import requests
from tests.bridges.driver import Columns, Driver, constant
from tests.network import Net, Sample
from tests.waiting import ManualClock, until

KEYS = Keys()
ROWS = {"CF01": "crazyflie", "TE01": "tello", "KH01": "khepera4"}
HERE = (0.0, 0.0, 0.0)


def body_of(endpoint, *names, address="external", open_s=0.05, **device):
    rows = {name: ROWS[name] for name in names or ROWS}
    asked = requests.request(
        list(rows.values()), address, names=list(rows), yaw=0.25, device=device, endpoints=(endpoint,), keys=KEYS
    )
    return ExternalBody(asked, open_s)


class Far(Net):
    """The other side on a network without Zenoh, its clock, the commands `told`, and `place` of each robot in `run`."""

    def __init__(self, monkeypatch):
        super().__init__()
        self.clock, self.told, self.place = ManualClock(1000.0), [], {}
        monkeypatch.setattr(time, "clock_gettime", lambda _: self.clock.now)
        monkeypatch.setattr(time, "time", lambda: 1.7e9 + self.clock.now)

    def publisher(self, _session, _key, mime, *_):
        return SimpleNamespace(put=lambda data: self.told.append(messages.decode(data, mime, messages.Command)))

    def put(self, key, data):
        self.first[key] = Sample(key, messages.JSON, data)
        self.deliver(b"\0".join((key.encode(), messages.JSON.encode(), data)))

    def say(self, name, position=HERE, yaw=0.5, stamp=None):
        stamp = time.time() if stamp is None else stamp
        said = {"robot": name, "stamp": stamp, "position": position, "yaw": yaw}
        self.put(KEYS.position(name), json.dumps(said).encode())

    def sweep(self, name, *distance, robot=None):
        angles = [0.1 * k for k in range(len(distance))]
        said = messages.Ranges(robot or name, time.time(), angles, [0.0] * len(distance), list(distance))
        self.put(KEYS.ranges(name), messages.encode(said))

    def body(self, *names):
        """An open body."""
        for name in names:
            self.say(name)
        made = body_of("tcp/127.0.0.1:1", *names)
        made.open()
        return made

    def read(self, body, seconds):
        self.clock.sleep(seconds)
        return Columns(body.read(self.clock.now - 1000.0))

    def run(self, body, seconds, *setpoints):
        """Read and command, 50 times a second."""
        for _ in range(round(seconds / 0.02)):
            for name, position in self.place.items():
                self.say(name, position)
            state = self.read(body, 0.02)
            body.command(setpoints or [NO_SETPOINT] * len(state.time))
        return state

    def actions(self, name, action):
        return [command for command in self.told if (command.robot, command.action) == (name, action)]

    def counts(self):
        """How often each was told what, since the last call."""
        counted = [(command.robot, command.action) for command in self.told]
        self.told.clear()
        return {each: counted.count(each) for each in counted}


about = partial(pytest.approx, rel=0.25)


@pytest.fixture
def far(monkeypatch):
    made = Far(monkeypatch)
    with made.worn():
        monkeypatch.setattr(pubsub, "publisher", made.publisher)
        yield made


@pytest.mark.parametrize(
    ("robots", "say", "words"),
    [
        (("external", "CF01", "TE01"), lambda far: far.say("CF01"), "TE01: nothing is published on "
         "park/TE01/position: is the simulator running and connected to tcp/127.0.0.1:1?"),
        (("world", "CF01"), lambda _: None, "CF01: nothing is published on park/CF01/position: is `./zenpark world "
         "serve` with this experiment running and connected to "),
        (("external", "KH01"), lambda far: far.say("KH01", stamp=12.5), "stamps are UTC seconds, not simulation time"),
        (("external", "KH01"), lambda far: far.say("KH01", stamp=time.time() - 7.0), "7.0 s ago by its stamp"),
        (("external", "KH01"), lambda far: far.say("KH01", yaw=None), "no yaw, without which a robot on wheels cannot"),
        (("external", "CF01"), lambda far: far.put("park/CF01/position", b'{"x": 1.0}'), "samples on "
         "park/CF01/position are not positions: no valid Position"),
    ],
)  # fmt: skip
def test_missing_positions_are_named_with_reasons(far, robots, say, words):
    address, *names = robots
    say(far)
    with pytest.raises(BodyError, match=rf"\A.*{re.escape(words)}.*\Z"):  # one line
        body_of("tcp/127.0.0.1:1", *names, address=address).open()
    with pytest.raises(BodyError, match=r"CF01: device: .*`rate`; its fields are watchdog_s"):
        body_of("tcp/127.0.0.1:1", "CF01", rate=5)


def test_poses_are_as_published_and_grow_old(far):
    body, seen = far.body(*ROWS), pytest.approx((0.145, 0.0, 0.0), abs=1e-12)
    assert "no position for" in far.read(body, 1.0).note[0]
    for step in range(30):  # half a metre a second along x, with one frame that is elsewhere
        far.say("CF01", (0.005 * step + 3.0 * (step == 20), 0.0, 0.0), None, time.time() - 0.29 + 0.01 * step)
    state = far.read(body, 0.0)
    assert state.position[0] == seen
    assert state.velocity[0] == pytest.approx((0.5, 0.0, 0.0), abs=0.05)
    assert state.time[0] == pytest.approx(1.0, abs=1e-5)
    assert state.yaw == pytest.approx(0.5)
    assert np.isnan([*state.true_position.flat, *state.battery]).all()
    assert not state.flying.any()
    later = far.read(body, 2.0)
    assert all("no position for" in note for note in later.note)
    assert later.time == pytest.approx(state.time, abs=1e-5)
    far.put(KEYS.position("CF01"), b"\xff\x00")
    far.say("CF01", (nan, 0.0, 0.0))
    far.say("CF01", stamp=time.time() + 3600.0)
    far.put(KEYS.position("CF01"), b'{"robot":"KH01","stamp":1.0,"position":[0,0,0]}')
    state = far.read(body, 0.01)
    assert ("4 positions refused" in state.note[0], state.position[0]) == (True, seen)
    far.say("CF01", (1.0, 0.0, 0.0))
    state = far.read(body, 0.01)
    assert (state.position[0, 0], "no position" in state.note[0]) == (1.0, False)


def test_what_robots_see_comes_from_the_far_end(far):
    body = far.body(*ROWS)
    assert far.read(body, 0.01).scan == (None,) * 3
    far.sweep("KH01", 0.25, None, 1.5)
    far.sweep("CF01", 2.0)
    first, second, third = far.read(body, 0.01).scan
    assert (first.distance, second) == ((2.0,), None)
    assert third.distance == (0.25, pytest.approx(nan, nan_ok=True), 1.5)
    assert (third.bearing, third.time) == (pytest.approx((0.0, 0.1, 0.2)), pytest.approx(0.01, abs=1e-5))
    far.sweep("KH01", 0.1, robot="TE01")
    far.read(body, 0.01)
    assert any("1 sweeps refused" in note for note in far.read(body, 0.01).note)
    assert far.read(body, 1.1).scan == (None,) * 3, "what is old is forgotten"


def test_restarted_simulator_hears_orders_under_way(far):
    """The twin service was killed while one robot climbed and the other landed; its successor knows of neither."""
    body = far.body(*ROWS)
    body.takeoff([0, 1], [0.6, 0.8])
    far.place = dict.fromkeys(ROWS, (0.0, 0.0, 0.3))
    far.run(body, 1.0)
    body.land([1])
    far.run(body, 0.5)
    climb, landing = far.actions("CF01", "takeoff")[-1].seq, far.actions("TE01", "land")[-1].seq
    silent, far.place = far.place, {}
    state = far.run(body, 2.0)
    assert "no position" in state.note[0]
    assert state.flying.tolist() == [True, True, False]
    far.place = silent
    far.told.clear()
    far.run(body, 1.0)
    assert {command.seq for command in far.actions("CF01", "takeoff")} == {climb}
    assert {command.seq for command in far.actions("TE01", "land")} == {landing}
    far.run(body, 0.1, (0.0, 0.0, 0.6, 0.0), NO_SETPOINT, NO_SETPOINT)
    far.told.clear()
    far.run(body, 1.0, (0.0, 0.0, 0.6, 0.0), NO_SETPOINT, NO_SETPOINT)
    assert far.counts() == about({("CF01", "drive"): 50, ("TE01", "land"): 50})  # what is steered need not climb


@pytest.mark.parametrize("order", ["land", "stop"])
def test_descent_of_a_killed_process_is_adopted(far, order):
    """A robot lower than a table that still comes down for a process that is gone is not down yet (seed 1027577)."""
    body = far.body("CF01")
    for z in np.arange(0.45, 0.3, -0.006):
        far.place = {"CF01": (0.0, 0.0, float(z))}
        state = far.run(body, 0.02)
    assert not state.flying.any()
    getattr(body, order)([0])
    assert far.run(body, 0.1).flying.all()
    far.place = {"CF01": HERE}
    assert not far.run(body, 1.5).flying.any()


def test_stop_is_repeated_as_the_last_word(far):
    body, rows = far.body(*ROWS), range(3)
    far.place = dict.fromkeys(ROWS, HERE)
    body.takeoff(rows, [0.6, 0.8, 0.0])
    assert far.run(body, 1.0).flying.tolist() == [True, True, False]
    climbs = far.actions("CF01", "takeoff")
    assert {(command.seq, command.height) for command in climbs} == {(climbs[0].seq, 0.6)}
    assert {command.height for command in far.actions("TE01", "takeoff")} == {0.8}
    assert far.counts() == about({("CF01", "takeoff"): 51, ("TE01", "takeoff"): 51})
    far.place |= {"CF01": (0.0, 0.0, 0.3), "TE01": (0.0, 0.0, 0.3)}
    far.run(body, 1.0)
    assert far.counts() == about({("CF01", "takeoff"): 50, ("TE01", "takeoff"): 50})  # half-way up another may answer
    body.land(rows)
    assert far.run(body, 4.0).flying.tolist() == [True, True, False]
    assert {command.seq for command in far.actions("CF01", "land")} == {climbs[0].seq + 1}
    assert far.counts() == about({("CF01", "land"): 201, ("TE01", "land"): 201, ("KH01", "land"): 151})
    far.place["CF01"] = (0.0, 0.0, 0.01)
    assert far.run(body, 1.0).flying.tolist() == [False, True, False]
    far.told.clear()
    body.stop([1, 2])
    body.takeoff([1, 2], [1.0, 1.0])
    body.land([1, 2])
    state = far.run(body, 3.0, *[(1.0, 1.0, 1.0, 1.0)] * 3)
    assert state.flying.tolist() == [False, True, False]
    assert [UNANSWERED in note for note in state.note] == [False, True, False]  # the one on wheels stands
    assert {command.seq for command in far.actions("TE01", "stop")} == {climbs[0].seq + 2}
    assert far.counts() == about({("CF01", "drive"): 150, ("TE01", "stop"): 151, ("KH01", "stop"): 151})
    far.place["TE01"] = HERE
    state = far.run(body, 1.0)
    assert not state.flying.any()
    assert not any(state.note)
    far.counts()
    far.run(body, 2.0)
    assert far.counts() == about({("TE01", "stop"): 20, ("KH01", "stop"): 20})


@pytest.mark.mechanism("external body: orders are repeated", "external body: router loss")
@pytest.mark.system
def test_it_outlives_its_router(router):
    with network.open_session([router.endpoint], name="far end") as session:
        commands = pubsub.subscriber(session, KEYS.setpoint("*"), 4096)
        body = body_of(router.endpoint, "CF01", open_s=5.0)
        told, process = [], Driver(body, constant(1.0, 1.0, 1.0, 1.0))

        def look():
            said = {"robot": "CF01", "stamp": time.time(), "position": HERE, "yaw": 0.0}
            session.put(KEYS.position("CF01"), json.dumps(said), encoding=messages.JSON)
            data = [sample.payload.to_bytes() for sample in network.received(commands.handler)]
            told.extend(messages.decode(each, messages.JSON, messages.Command) for each in data)
            return len(told)

        opening = threading.Thread(target=body.open)
        opening.start()
        until(lambda: look() or not opening.is_alive())
        body.stop([0])
        process.until(lambda: look() > 3, "the stop is repeated")
        router.kill()
        process.until(lambda: process.state.note[0], "silence is noticed")
        router.start()
        before = look()
        process.until(lambda: look() > before and "no position" not in process.state.note[0], "it is heard again")
        assert {(command.action, command.seq) for command in told} == {("stop", told[0].seq)}
        body.close()


def test_setpoints_are_sent_once_nan_never(far):
    body = far.body(*ROWS)
    for step in range(10):
        far.read(body, 0.01)
        x = 4.0 * step
        body.command([(x, x + 1.0, x + 2.0, x + 3.0), NO_SETPOINT, (x + 200.0, 0.0, 0.0, 0.0)])
    for name, first in (("CF01", 0.0), ("KH01", 200.0)):
        drives = far.actions(name, "drive")
        assert [command.setpoint[0] for command in drives] == [first + 4.0 * step for step in range(10)]
        assert [command.seq - drives[0].seq for command in drives] == list(range(10))
        assert drives[0].seq > 1e3 * (time.time() - 60.0)  # and grow from one process to the next
        assert drives[-1].stamp == pytest.approx(time.time(), abs=1e-5)
    assert len(far.told) == 20


def test_numbers_after_standstill_exceed_those_of_successor(far):
    def numbers(body):
        far.told.clear()
        far.run(body, 2.0, (0.0, 0.0, 0.0, 0.0))
        return [command.seq for command in far.told]

    first = far.body("CF01")
    before = numbers(first)
    assert set(np.diff(before)) == {1}
    far.clock.sleep(30.0)  # it stands still; another process takes the name, and ends
    between = numbers(far.body("CF01"))
    assert numbers(first)[0] > between[-1] > before[-1]


def test_pose_of_wheels_is_as_old_as_yaw(far):
    """A robot that steers by a yaw that is not told any more has no position; one in the air does."""
    body = far.body(*ROWS)
    for k in range(1, 300):
        for name in ROWS:
            far.say(name, (1e-5 * k, 0.0, 0.0), yaw=2.0 if k <= 100 else None)
        states = far.read(body, 0.01)
        assert k != 140 or states.time[2] == pytest.approx(1.39)
    assert (states.yaw.tolist(), states.note) == ([2.0] * 3, ("", "", "no yaw for 2 s"))
    assert states.time == pytest.approx([2.98, 2.98, 0.99])


DT = 0.1


class Seen(MeasuredFlight):
    """A robot that is measured all the time."""

    def __init__(self, start, to=None, *, climbing=False):
        super().__init__()
        self.now, self.at, self.climbing = 0.0, start, climbing
        self.take_off(start)
        if to is not None:
            self.go(to, 4.0)

    def go(self, to, seconds):
        """Fly to a place in so long; returns whether the flight is over."""
        velocity = tuple((there - here) / seconds for there, here in zip(to, self.at, strict=True))
        for _ in range(round(seconds / DT)):
            self.now += DT
            self.at = tuple(here + DT * speed for here, speed in zip(self.at, velocity, strict=True))
            self.update(self.now, self.now, self.at, velocity, climbing=self.climbing)
        return not self.flying

    def stay(self, seconds):
        return self.go(self.at, seconds)


@pytest.mark.parametrize("z", [0.0, 0.08, 0.7])
def test_flight_from_floor_or_table_ends_in_place(z):
    seen = Seen((0.0, 0.0, z))
    for x, seconds in ((0.0, 2.0), (1.0, 5.0), (0.0, 5.0)):
        assert not seen.go((x, 0.0, 1.2), seconds)
    seen.land(seen.now)
    assert not seen.go((0.0, 0.0, z + 0.06), 2.0)
    assert seen.go((0.0, 0.0, z), 0.5) or seen.stay(0.2)


def test_slow_flight_below_its_table_goes_on():
    seen = Seen((0.0, 0.0, 0.7), to=(0.0, 0.0, 1.0))
    seen.go((1.0, 0.0, 0.4), 4.0)
    assert not seen.stay(20.0)
    seen.go((1.0, 0.0, 0.7), 4.0)
    assert not seen.stay(20.0)  # as high as its table, beside it
    seen.go((1.0, 0.0, 0.0), 4.0)
    assert seen.stay(GROUNDED_S + 0.2)


def test_landing_on_another_table_ends():
    seen = Seen(HERE, to=(1.0, 0.0, 1.2))
    seen.land(seen.now)
    assert not seen.stay(60.0), "a hover that refuses to land goes on"
    seen.go((1.0, 0.0, 0.7), 2.0)
    assert [seen.stay(seconds) for seconds in (LANDING_S - 1.0, 1.5)] == [False, True]
    seen = Seen(HERE, climbing=True)
    assert not seen.stay(30.0), "it stands before it rises"
    seen.climbing = False
    assert seen.stay(GROUNDED_S + 0.2)


@pytest.mark.parametrize(("z", "lasts_s"), [(nan, LANDING_S), (0.5, LANDING_S), (4.0, 4.0 / LOWEST_DESCENT_M_S)])
def test_unseen_landing_ends_however_often_ordered(z, lasts_s):
    flight, over = MeasuredFlight(), []
    flight.take_off(UNKNOWN)
    for step in range(round((lasts_s + 1.0) / DT)):
        now = step * DT
        flight.land(now)
        over.append(flight.update(now, -inf, (0.0, 0.0, z), UNKNOWN, climbing=False))
    assert over.index(True) == pytest.approx(lasts_s / DT, abs=2)
