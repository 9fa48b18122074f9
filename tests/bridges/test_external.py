"""The external body: what it says on the network, and what it believes."""

import json
import threading
import time
from itertools import pairwise
from math import nan
from types import SimpleNamespace

import numpy as np
import pytest

from agents.body.interface import UNANSWERED, BodyError
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.safety.detection import LOWEST_DESCENT_M_S
from agents.vectors import NO_SETPOINT
from bridges.external import ExternalBody
from bridges.measured_flight import LANDING_S
from tests import requests
from tests.bridges.driver import Driver, constant
from tests.network import Net, Sample
from tests.waiting import ManualClock, until

KEYS = Keys()
ROWS = {"CF01": "crazyflie", "TE01": "tello", "KH01": "khepera4"}


def body_of(endpoint, *names, address="external", open_s=0.5, **device):
    rows = {name: ROWS[name] for name in names or ROWS}
    asked = requests.request(
        list(rows.values()), address, names=list(rows), yaw=0.25, device=device, endpoints=(endpoint,), keys=KEYS
    )
    return ExternalBody(asked, open_s)


class FarEnd:
    """The other side, by hand: where each robot is, and what it was told."""

    def __init__(self, endpoint):
        self.session = network.open_session([endpoint], name="far end")
        self._subscriber = pubsub.subscriber(self.session, KEYS.setpoint("*"), 4096)
        self.told = []
        self.place = {name: [0.0, 0.0, 0.0] for name in ROWS}
        self._quiet, self._thread = threading.Event(), None

    def put(self, name, data):
        self.session.put(KEYS.position(name), data, encoding=messages.JSON)

    def say(self, name, position, *, stamp=None, yaw=0.5):
        stamp = time.time() if stamp is None else stamp
        self.put(name, json.dumps({"robot": name, "stamp": stamp, "position": position, "yaw": yaw}))

    def repeat(self, say):
        """Calls something 100 times a second, in a thread, until `hush`."""

        def keep_saying():
            while not self._quiet.wait(0.01):
                say()

        self._quiet.clear()
        self._thread = threading.Thread(target=keep_saying)
        self._thread.start()

    def talk(self, *names):
        """Says where they are, until `hush`."""
        self.repeat(lambda: [self.say(name, self.place[name]) for name in names])

    def hush(self):
        self._quiet.set()
        if self._thread is not None:
            self._thread.join()

    def look(self):
        for sample in network.received(self._subscriber.handler):
            self.told.append(messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Command))
        return self.told

    def actions(self, name, action):
        return [command for command in self.look() if (command.robot, command.action) == (name, action)]

    def close(self):
        self.hush()
        self.session.close()


@pytest.fixture
def far(router):
    made = FarEnd(router.endpoint)
    yield made
    made.close()


@pytest.fixture
def driven_body(router, far):
    """Drives a body that is open, at the other end of `far`, which talks."""
    far.talk(*ROWS)
    body = body_of(router.endpoint, open_s=5.0)
    body.open()
    driver = Driver(body)
    driver.tick()
    yield driver
    body.close()


def lowest(driven_body):
    """Height of the lower of both drones [m]."""
    return driven_body.state.position[:2, 2].min()


# ---------------------------------------------------------------------- opening


def said(**parts):
    return lambda far: far.say("KH01", [0.0, 0.0, 0.0], yaw=None, **parts)


@pytest.mark.system
@pytest.mark.parametrize(
    ("robots", "say", "words"),
    [
        (("external", "CF01", "TE01"), lambda far: far.say("CF01", [0.0, 0.0, 0.0]), "TE01: nothing is published on "
         "park/TE01/position: is the simulator running and connected to {}?"),
        (("world", "CF01"), lambda _: None, "CF01: nothing is published on park/CF01/position: is `./zenpark world "
         "serve` with this experiment running and connected to {}?"),
        (("external", "KH01"), said(stamp=12.5), "stamps are UTC seconds, not simulation time"),
        (("external", "KH01"), said(stamp=time.time() - 7.0), "s ago by its stamp"),
        (("external", "KH01"), said(), "no yaw, without which a robot on wheels cannot steer"),
        (("external", "CF01"), lambda far: far.put("CF01", b'{"x": 1.0}'), "samples on park/CF01/position are not "
         "positions: not a Position"),
    ],
)  # fmt: skip
def test_missing_positions_are_named_with_reasons(router, far, robots, say, words):
    address, *names = robots
    far.repeat(lambda: say(far))
    with pytest.raises(BodyError) as caught:
        body_of(router.endpoint, *names, address=address).open()
    assert words.format(router.endpoint) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.system
def test_settings_and_absent_routers_are_named():
    with pytest.raises(BodyError, match=r"CF01: device: .*`rate`.*has no settings"):
        body_of("tcp/127.0.0.1:1", "CF01", rate=5)
    with pytest.raises(BodyError, match="CF01: no router answers at"):
        body_of(free_endpoint(preferred_port=0), "CF01").open()


# ---------------------------------------------------------------------- what it believes


@pytest.mark.system
def test_poses_are_as_published_and_grow_old(driven_body, far):
    far.hush()
    driven_body.until(lambda: driven_body.state.note[0], "what was said before is old")
    utc, clock = time.time(), time.monotonic() - driven_body.zero
    for step in range(30):  # half a metre a second along x, with one frame that is elsewhere
        jump = 3.0 if step == 20 else 0.0
        far.say("CF01", [0.005 * step + jump, 0.0, 0.0], stamp=utc - 0.29 + 0.01 * step, yaw=None)
    driven_body.until(lambda: driven_body.state.position[0, 0] >= 0.14, "the last of them is heard")
    state = driven_body.state
    assert state.position[0] == pytest.approx((0.145, 0.0, 0.0), abs=1e-12)
    assert state.velocity[0] == pytest.approx((0.5, 0.0, 0.0), abs=0.05)
    assert state.time[0] == pytest.approx(clock, abs=0.01)
    assert state.yaw == pytest.approx(0.5)
    assert np.isnan(state.true_position).all()
    assert np.isnan(state.battery).all()
    assert not state.flying.any()
    driven_body.until(lambda: all("no position for" in note for note in driven_body.state.note), "they grow old")
    assert driven_body.state.time == pytest.approx(state.time, abs=0.02)
    far.put("CF01", b"\xff\x00")
    far.say("CF01", [nan, 0.0, 0.0])
    far.say("CF01", [0.0, 0.0, 0.0], stamp=time.time() + 3600.0)
    far.put("CF01", b'{"robot":"KH01","stamp":1.0,"position":[0,0,0]}')
    driven_body.until(lambda: "4 positions refused" in driven_body.state.note[0], "nonsense is counted")
    assert driven_body.state.position[0] == pytest.approx((0.145, 0.0, 0.0), abs=1e-12)
    far.talk(*ROWS)
    driven_body.until(
        lambda: driven_body.state.position[0, 0] == 0.0 and "no position" not in driven_body.state.note[0], "it is back"
    )


@pytest.mark.system
def test_what_robots_see_comes_from_the_far_end(driven_body, far):
    assert driven_body.state.scan == (None,) * 3

    def say(name, *distance, robot=None):
        angles = [0.1 * k for k in range(len(distance))]
        sweep = messages.Ranges(robot or name, time.time(), angles, [0.0] * len(distance), list(distance))
        far.session.put(KEYS.ranges(name), messages.encode(sweep), encoding=messages.JSON)

    say("KH01", 0.25, None, 1.5)
    say("CF01", 2.0)
    driven_body.until(
        lambda: driven_body.state.scan[0] is not None and driven_body.state.scan[2] is not None, "they are heard"
    )
    first, second, third = driven_body.state.scan
    assert second is None
    assert first.distance == (2.0,)
    assert third.distance == (0.25, pytest.approx(nan, nan_ok=True), 1.5)
    assert third.bearing == pytest.approx((0.0, 0.1, 0.2))
    assert third.time == pytest.approx(time.monotonic() - driven_body.zero, abs=0.5)
    say("KH01", 0.1, robot="TE01")
    driven_body.until(lambda: any("1 sweeps refused" in note for note in driven_body.state.note), "nonsense is counted")
    driven_body.until(lambda: driven_body.state.scan == (None,) * 3, "what is old is forgotten")


# ---------------------------------------------------------------------- what it says


@pytest.mark.system
def test_restarted_simulator_hears_orders_under_way(driven_body, far):
    """The twin service was killed while one robot climbed and the other landed; its successor knows of neither."""
    driven_body.body.takeoff([0, 1], [0.6, 0.8])
    far.place["CF01"] = far.place["TE01"] = [0.0, 0.0, 0.3]
    driven_body.until(lambda: lowest(driven_body) > 0.2, "they are up")
    driven_body.body.land([1])
    driven_body.until(lambda: far.actions("TE01", "land"), "one lands")
    climb, landing = far.actions("CF01", "takeoff")[-1].seq, far.actions("TE01", "land")[-1].seq
    far.hush()
    driven_body.until(lambda: any("no position" in note for note in driven_body.state.note), "silence is noticed")
    assert driven_body.state.flying.tolist() == [True, True, False]
    assert far.actions("TE01", "drive") == []
    told = len(far.actions("CF01", "takeoff"))
    far.talk(*ROWS)
    driven_body.until(lambda: len(far.actions("CF01", "takeoff")) >= told + 5, "it is told again to climb")
    assert {command.seq for command in far.actions("CF01", "takeoff")} == {climb}
    assert {command.seq for command in far.actions("TE01", "land")} == {landing}
    driven_body.decide = lambda _: [(0.0, 0.0, 0.6, 0.0), NO_SETPOINT, NO_SETPOINT]
    driven_body.until(lambda: far.actions("CF01", "drive"), "it is steered")
    told = len(far.actions("CF01", "takeoff"))
    driven = len(far.actions("CF01", "drive"))
    driven_body.until(lambda: len(far.actions("CF01", "drive")) > driven + 40, "it is steered on")
    assert len(far.actions("CF01", "takeoff")) <= told + 1, "what is steered need not climb"


@pytest.mark.mechanism("external body: orders are repeated")
@pytest.mark.system
def test_orders_are_repeated_until_obeyed(driven_body, far):
    rows = range(3)
    driven_body.body.takeoff(rows, [0.6, 0.8, 0.0])
    driven_body.until(lambda: len(far.actions("CF01", "takeoff")) >= 3, "takeoff is repeated")
    assert driven_body.state.flying.tolist() == [True, True, False]
    first = far.actions("CF01", "takeoff")[0].seq
    assert {(c.seq, c.height) for c in far.actions("CF01", "takeoff")} == {(first, 0.6)}
    assert {c.height for c in far.actions("TE01", "takeoff")} == {0.8}
    assert far.actions("KH01", "takeoff") == []
    far.place["CF01"] = [0.0, 0.0, 0.3]
    far.place["TE01"] = [0.0, 0.0, 0.3]
    driven_body.until(lambda: lowest(driven_body) > 0.2, "they are up")
    told = len(far.actions("CF01", "takeoff"))
    driven_body.until(lambda: len(far.actions("CF01", "takeoff")) >= told + 5, "another may answer half-way up")
    silent = len(far.actions("CF01", "takeoff"))
    again = len(far.actions("TE01", "takeoff"))

    driven_body.body.land(rows)
    driven_body.until(lambda: len(far.actions("CF01", "land")) >= 3, "land is repeated")
    assert len(far.actions("CF01", "takeoff")) - silent <= 1
    assert len(far.actions("TE01", "takeoff")) - again <= 1
    assert driven_body.state.flying.tolist() == [True, True, False]
    assert {c.seq for c in far.actions("CF01", "land")} == {first + 1}
    assert len(far.actions("KH01", "land")) >= 1
    far.place["CF01"] = [0.0, 0.0, 0.01]
    driven_body.until(lambda: not driven_body.state.flying[0], "one is down")
    assert driven_body.state.flying.tolist() == [False, True, False]

    driven_body.body.stop([1, 2])
    driven_body.body.land([1, 2])  # a stop is the last word
    driven_body.decide = constant(1.0, 1.0, 1.0, 1.0)
    driven_body.until(lambda: len(far.actions("TE01", "stop")) >= 5, "stop is repeated")
    assert driven_body.state.flying.tolist() == [False, True, False]  # it is seen where it was
    driven_body.until(lambda: UNANSWERED in driven_body.state.note[1], "it is said")
    assert UNANSWERED not in driven_body.state.note[2]  # it stands
    far.place["TE01"] = [0.0, 0.0, 0.0]
    driven_body.until(lambda: not driven_body.state.flying.any(), "it has come down")
    assert not any(driven_body.state.note)
    assert {c.seq for c in far.actions("TE01", "stop")} == {first + 2}
    assert len(far.actions("KH01", "stop")) >= 5
    assert far.actions("TE01", "drive") == far.actions("KH01", "drive") == []  # a stop is the last word
    assert len(far.actions("CF01", "drive")) >= 5


@pytest.mark.system
def test_setpoints_are_sent_once_nan_never(driven_body, far):
    for step in range(10):
        x = 4.0 * step
        driven_body.body.command([(x, x + 1.0, x + 2.0, x + 3.0), NO_SETPOINT, (x + 200.0, 0.0, 0.0, 0.0)])
    until(lambda: len(far.look()) >= 20, "they arrive")
    for name, first in (("CF01", 0.0), ("KH01", 200.0)):
        drives = far.actions(name, "drive")
        assert [command.setpoint[0] for command in drives] == [first + 4.0 * step for step in range(10)]
        assert [command.seq - drives[0].seq for command in drives] == list(range(10))
        assert drives[0].seq > 1e3 * (time.time() - 60.0)  # and grow from one process to the next
        assert all(abs(command.stamp - time.time()) < 5.0 for command in drives)
    assert far.actions("TE01", "drive") == []


@pytest.mark.mechanism("external body: router loss")
@pytest.mark.system
def test_it_outlives_its_router(driven_body, far, router):
    router.kill()
    driven_body.decide = constant(1.0, 1.0, 1.0, 1.0)
    driven_body.until(lambda: driven_body.state.note[0], "silence is noticed")
    before = len(far.look())
    router.start()
    driven_body.until(lambda: not any(driven_body.state.note), "it is back")
    driven_body.until(lambda: len(far.look()) > before, "it is heard again")


# ---------------------------------------------------------------------- on a clock of its own


class Alone(Net):
    """A network without Zenoh, and a clock that passes by hand: what bodies `told`."""

    def __init__(self, monkeypatch):
        super().__init__()
        self.clock, self.told = ManualClock(1000.0), []
        monkeypatch.setattr(time, "clock_gettime", lambda _: self.clock.now)
        monkeypatch.setattr(time, "time", lambda: 1.7e9 + self.clock.now)

    def publisher(self, _session, _key, mime, *_):
        return SimpleNamespace(put=lambda data: self.told.append(messages.decode(data, mime, messages.Command)))

    def say(self, name, z=0.0, yaw=0.5):
        """A position that is measured now, and no repetition."""
        position = messages.Position(name, time.time(), (1e-6 * self.clock.now, 0.0, z), yaw)
        data, key = messages.encode(position), KEYS.position(name)
        self.first[key] = Sample(key, messages.JSON, data)
        self.deliver(b"\0".join((key.encode(), messages.JSON.encode(), data)))

    def body(self, *names):
        """An open body."""
        for name in names:
            self.say(name)
        made = body_of("tcp/127.0.0.1:1", *names)
        made.open()
        return made

    def read(self, body, seconds):
        self.clock.sleep(seconds)
        return body.read(self.clock.now - 1000.0)


@pytest.fixture
def alone(monkeypatch):
    made = Alone(monkeypatch)
    with made.worn():
        monkeypatch.setattr(pubsub, "publisher", made.publisher)
        yield made


def test_numbers_after_standstill_exceed_those_of_successor(alone):
    def numbers(body):
        alone.told.clear()
        for _ in range(100):
            alone.read(body, 0.01)
            body.command([(0.0, 0.0, 0.0, 0.0)])
        return [command.seq for command in alone.told]

    first = alone.body("CF01")
    before = numbers(first)
    assert [later - sooner for sooner, later in pairwise(before)] == [1] * 99
    alone.clock.sleep(30.0)  # it stands still; another process takes the name, and ends
    between = numbers(alone.body("CF01"))
    assert numbers(first)[0] > between[-1] > before[-1]


def test_no_take_off_after_a_stop(alone):
    body = alone.body("CF01")
    body.stop([0])
    body.takeoff([0], [1.0])
    body.land([0])
    body.command([NO_SETPOINT])
    assert [command.action for command in alone.told] == ["stop", "stop"]


def test_pose_of_wheels_is_as_old_as_yaw(alone):
    """A robot that steers by a yaw that is not told any more has no position; one in the air does."""
    body = alone.body(*ROWS)
    for k in range(1, 300):
        for name in ROWS:
            alone.say(name, yaw=2.0 if k <= 100 else None)
        states = alone.read(body, 0.01)
        if k == 140:
            assert states[2].time == pytest.approx(1.39)
    assert [state.yaw for state in states] == [2.0] * 3
    assert [state.time for state in states] == pytest.approx([2.98, 2.98, 0.99])
    assert [state.note for state in states] == ["", "", "no yaw for 2 s"]


def test_unseen_landing_ends_at_last(alone):
    body, heights, ended = alone.body("CF01", "TE01"), {"CF01": 0.5, "TE01": 0.5}, []
    body.takeoff([0, 1], [0.6, 0.6])
    for k in range(300):
        if k == 20:
            body.land([0, 1])
            del heights["CF01"]  # nobody sees it any more; the other one is seen, and does not come down
        for name, z in heights.items():
            alone.say(name, z)
        states = alone.read(body, 0.1)
        ended.append(not states[0].flying)
    assert 0.1 * (ended.index(True) - 20) == pytest.approx(max(LANDING_S, 0.5 / LOWEST_DESCENT_M_S), abs=0.2)
    assert states[1].flying
    assert states[0].note.startswith("no position for")
