"""A neighbour is alive by its token alone, a new process of it is a new life; what telemetry reports; ranges."""

import random
from copy import copy
from itertools import count
from math import nan, pi
from types import SimpleNamespace

import pytest
import zenoh

from agents.body.interface import BodyState, RangeScan
from agents.network import messages, pubsub, validation
from agents.network.channel_model import Conditions
from agents.network.keys import Keys
from agents.plugins.predictors import ConstantVelocity
from agents.robot import Robot
from agents.runtime import range_inbox
from agents.runtime.pose_inbox import LATE_S, MAX_UNREPORTED, PoseInbox
from agents.runtime.telemetry import Counts, TelemetryPublisher
from agents.safety.detection import FOREIGN_S
from agents.vectors import UNKNOWN
from experiments.definition.plan import Plan
from tests import network
from tests.agents.runtime.process import twins
from tests.fuzz.messages import sent
from tests.small import pair

UTC, KEYS = 1.7e9, Keys()
ALIVE = KEYS.alive("B")


class Receiver:
    """A, alone in its process, and B, of which the test says everything; `t` [s] is its time."""

    def __init__(self, net: network.Net, delay_s: float = 0.0) -> None:
        self.net, self.robot, self.t = net, Robot(Plan(pair()).assignment("A")), 0.0
        self._numbers = count()
        conditions = [[Conditions(delay=delay_s)]] if delay_s else ()
        self.inbox = PoseInbox(net.session, KEYS, [self.robot], valid_box=(5.0, 5.0, 5.0), conditions=conditions)
        (self.neighbour,) = self.robot.neighbours.all
        (self.sender,) = self.inbox.senders

    def add(self, key: str, payload: bytes = b"", *, gone: bool = False, session: str | None = None) -> None:
        sample = network.Sample(key, messages.JSON, payload, gone=gone)
        if session is not None:
            source = SimpleNamespace(zid=session)
            sample.source_info = SimpleNamespace(source_id=source, source_sn=next(self._numbers))
        for channel in self.net.channels:
            if channel.expression.intersects(zenoh.KeyExpr(key)):
                channel.add(sample)

    def pose(self, seq: int, x: float, session: str | None, *, age: float = 0.0, speed: float = 0.0) -> None:
        """A pose of B is on its way."""
        pose = messages.pose("B", seq, UTC + self.t - age, [x, 0.0, 0.0], [speed, 0.0, 0.0], yaw=0.0)
        self.add(KEYS.pose("B"), messages.encode(pose), session=session)

    def receive(self, seq: int, x: float, session: str | None, *, age: float = 0.0, then: float = 0.02) -> None:
        """A pose of B is received; `then` [s] go by."""
        self.pose(seq, x, session, age=age)
        self.after(then)

    def life(self, session: str, *, gone: bool = False) -> None:
        self.add(Keys.life(ALIVE, session), gone=gone)

    def token(self, session: str | None, *, gone: bool = False) -> None:
        """The tokens of B, as they come and go together."""
        if session is not None:
            self.life(session, gone=gone)
        self.add(ALIVE, gone=gone)

    def begin(self, session: str | None, seq: int = 1) -> None:
        self.token(session)
        self.receive(seq, 0.4, session)

    def lose(self, session: str | None, then: float = 2.0) -> None:
        """The tokens of B vanish; `then` [s] go by."""
        self.token(session, gone=True)
        self.after(then)

    def after(self, seconds: float = 0.02) -> None:
        self.inbox.deliver(self.t, UTC)
        self.robot.goals.update_links(self.t)
        self.t += seconds

    @property
    def x(self) -> float | None:
        """Where B takes part in the law [m]; None: it is missing."""
        assert self.neighbour.active or self.robot.missing_neighbours() == ["B"]
        return self.neighbour.position[0] if self.neighbour.active else None

    @property
    def believed(self) -> float:
        """Where B is believed to be now by a predictor without a horizon, x [m]."""
        return self.neighbour.place(ConstantVelocity(), self.t)[0]

    @property
    def hazards(self) -> list[str]:
        """Findings of the safety checks about the neighbours."""
        neighbours, found = self.robot.neighbours, []
        if neighbours.lagging:
            found.append(f"behind by {self.neighbour.behind:.1f} s")
        if neighbours.refused:
            found.append("refused")
        if self.t - neighbours.foreign_at < FOREIGN_S:
            found.append(f"{self.neighbour.foreign} foreign")
        return found


@pytest.fixture
def a():
    with network.Net().worn() as net:
        yield Receiver(net)


def test_late_sample_revives_nobody_but_its_token(a):
    a.begin("one")
    a.lose("one")
    assert a.neighbour.active  # known so far to be gone for no time at all
    a.after()
    a.receive(2, 0.5, "one", age=2.5, then=500.0)
    assert a.x is None
    a.after()
    assert a.x is None
    a.token("one")
    a.after()
    assert a.x == 0.5


@pytest.mark.parametrize("behind_s", [1.0, 60.0, -3.0])
def test_restarted_neighbour_is_received_at_once(a, behind_s):
    a.token("one")
    for seq in range(1, 100):
        a.receive(seq, 0.4, "one", age=min(0.0, behind_s))
    a.lose("one")
    a.token("two")
    a.after()
    assert a.x is None  # where the former process was is not where this one is
    a.receive(1, -0.4, "two", age=max(0.0, behind_s))
    assert (a.x, a.sender.lost) == (-0.4, 0)
    a.receive(100, 0.4, "one")  # held back by the network since the first life
    assert (a.x, a.sender.foreign) == (-0.4, 1)


def test_other_make_begins_anew_with_its_token(a):
    a.begin(None, 7)
    a.lose(None, 1.0)
    a.token(None)
    a.receive(1, 0.3, None, age=30.0)
    assert a.x == 0.3
    a.receive(2, 0.2, None, age=90.0)  # its clock steps while it runs: the number says that it is newer
    assert a.x == 0.2
    a.receive(1, 0.9, None, age=95.0)
    assert (a.x, a.sender.stale) == (0.2, 1)


def test_restarted_robot_leaves_the_law(a):
    a.token("one")
    a.pose(7, 0.4, "one", speed=0.3)
    a.after()
    a.lose("one", 5.0)
    a.life("two")  # its body is opened, which takes a minute, or fails
    a.after(60.0)
    a.after()
    assert a.x is None
    assert (a.neighbour.position[0], a.believed) == (0.4, 0.4)
    assert a.neighbour.silent
    a.add(ALIVE)
    a.after()
    assert a.x is None
    a.receive(1, -0.2, "two")
    assert a.x == -0.2
    assert not a.neighbour.silent


@pytest.mark.parametrize("source", [None, "storage", "one"])
def test_stored_pose_before_the_first_token_is_void(a, source):
    a.receive(5000, 0.9, source, age=600.0)  # the answer of a storage to the first query, or of the robot's cache
    a.after()
    assert a.x is None
    assert a.robot.neighbours.unreceived()
    a.token("one")
    a.after()
    assert a.x == (0.9 if source == "one" else None)
    a.receive(5001 if source == "one" else 1, 0.4, "one")
    assert (a.x, a.sender.lost) == (0.4, 0)


def test_first_pose_may_precede_its_token(a):
    a.begin("one", 7)
    a.lose("one", 3.0)  # the router dies; meanwhile B is restarted
    a.receive(1, 0.6, "two")
    a.token("two")
    a.after()
    assert a.x == 0.6


@pytest.mark.parametrize("seed", range(60))
def test_remaining_process_is_received_after_any_turmoil(a, seed):
    chance, alive, plain = random.Random(seed), set(), False
    names = ("one", "two", "three", "four")
    seqs = dict.fromkeys(names, 0)
    clocks = {name: chance.choice([0.0, 0.0, 60.0, -4.0, -9.0, 3600.0]) for name in names}

    def speak(name: str, x: float) -> None:
        seqs[name] += 1
        a.pose(seqs[name], x, name, age=clocks[name])

    for _ in range(120):
        name, what = chance.choice(names), chance.randrange(7)
        if what == 0 or (what == 1 and name in alive):
            alive ^= {name}
            a.life(name, gone=name not in alive)
        elif what == 2:
            plain = not plain
            a.add(ALIVE, gone=not plain)
        elif what == 3:
            a.pose(chance.randrange(1, 9000), 0.9, None, age=chance.choice([0.0, 500.0]))
        elif what == 4:
            clocks[name] = chance.choice([0.0, 30.0, -3.0])  # its clock steps
        else:
            speak(name, 0.8)
        a.after(chance.choice([0.0, 0.02, 2.0]))
    for name in sorted(alive - {"one"}):
        a.life(name, gone=True)
    a.token("one")
    a.after()
    clocks["one"] = 0.0
    for _ in range(2):
        speak("one", 0.4)
        a.after()
    for session in (None, "two"):
        a.receive(9999, 0.9, session)
    assert a.x == 0.4


@pytest.mark.parametrize("sends", [True, False])
def test_neighbour_whose_poses_are_all_refused_is_lost(a, sends):
    a.begin("one")
    for seq in range(2, 72):
        if sends:
            a.pose(seq, 0.4, "one", age=-8.0)  # this process, or that one, has a wrong clock
        a.receive(seq, 0.4, "other", age=-8.0)  # which says nothing about B
    assert (a.robot.missing_neighbours(), a.hazards) == (["B"] * sends, ["refused"] * sends + ["70 foreign"])
    assert a.inbox.malformed == 70 * sends
    a.receive(90, 0.4, "one")
    a.after(1.0)
    assert (a.x, a.robot.missing_neighbours(), a.hazards) == (0.4, [], [])


def test_poses_that_are_always_old_are_a_hazard(a):
    a.token("one")
    a.receive(1, 0.4, "one", age=60.0)  # the last value of a robot that is silent: no proof
    assert a.hazards == []
    for seq in range(2, 5):
        a.receive(seq, 0.4, "one", age=LATE_S + 1.0)
    assert a.hazards == ["behind by 4.0 s"]
    a.receive(9, 0.4, "one")
    assert a.hazards == []
    a.t = 100.0
    for seq in range(10, 17):
        a.pose(seq, 0.4, "one", age=19.0 - seq)
    a.after()
    assert a.hazards == [], "poses that waited prove no slow clock"


@pytest.mark.parametrize("delay", [0.0, 5.0])
def test_slow_clock_carries_no_pose_far(delay):
    with network.Net().worn() as net:
        a = Receiver(net, delay)
    a.token("one")
    for seq in range(1, 5):
        a.pose(seq, 0.4, "one", age=60.0, speed=0.1)
        a.after(0.1)
    a.t += delay
    a.after(0.0)
    # the last pose came 0.1 s and the delay ago: a minute would have put it 6 m away
    assert a.believed == pytest.approx(0.4 + 0.1 * (LATE_S + 0.1 + delay), abs=1e-5)
    assert a.hazards == ["behind by 60.0 s"]
    a.t += 1.0
    assert a.believed == pytest.approx(0.4 + 0.1 * (LATE_S + 1.1 + delay), abs=1e-5)
    a.pose(5, 0.7, "one", age=0.5, speed=0.1)  # its clock was set right
    a.after(delay)
    a.after(0.0)
    assert a.believed == pytest.approx(0.7 + 0.1 * (0.5 + delay), abs=1e-5)


@pytest.mark.parametrize(
    ("poses", "carried_s"),
    [
        ([("one", 0.1, 0.0), ("two", 0.0, 60.0)], LATE_S),  # a slow clock is noticed at once after a restart
        ([("one", 30.1, 0.0), ("one", 0.0, 20.0)], 20.0),  # the last value while it was cut off, or silent
    ],
    ids=["restarted", "cut off"],
)
def test_old_pose_is_extrapolated_unless_clock_is_slow(a, poses, carried_s):
    a.token("one")
    for seq, (session, then, age) in enumerate(poses, 1):
        if session == "two":
            a.token("one", gone=True)
            a.token("two")
        a.pose(seq if session == "one" else 1, 0.4, session, age=age, speed=0.1)
        a.after(then)
    assert (a.believed, a.hazards) == (pytest.approx(0.4 + 0.1 * carried_s, abs=1e-5), [])


@pytest.mark.parametrize("ahead", [0.2, 4.0])
def test_pose_stamped_ahead_counts_from_arrival(a, ahead):
    a.token("one")
    a.t = 7.0
    a.pose(1, 0.4, "one", age=-ahead, speed=0.1)
    a.after(0.0)
    assert (a.neighbour.stamp, a.neighbour.arrival) == pytest.approx((7.0, 7.0), abs=1e-5)
    a.t += 2.0
    assert a.believed == pytest.approx(0.6, abs=1e-5), "two seconds old, not younger"
    (receipt,) = a.inbox.unreported[0]
    assert receipt.stamp == pytest.approx(UTC + 7.0 + ahead), "recorded as it was stamped"


class Reporter:
    """A of a pair, with receipts of poses of B."""

    def __init__(self, session):
        self.robot, self.body = Robot(Plan(pair()).assignment("A")), twins(pair(), "A")
        self.body.open()
        self.inbox = PoseInbox(session, KEYS, [self.robot], valid_box=(2.0, 2.0, 2.0))
        self.states = []
        self.telemetry = TelemetryPublisher(
            session, KEYS, "json",
            robots=[self.robot], neighbours=self.inbox, counts=Counts([0]), malformed=lambda: 0, ranged=[True],
        )  # fmt: skip
        self.telemetry.utc = UTC

    def receive(self, count):
        for seq in range(1, count + 1):
            at = UTC + 0.02 * seq
            self.inbox.unreported[0].append(messages.PoseReceipt("B", seq, at, at, (0.4, 0.1, 0.0), (0.123456, 0, 0)))

    def report(self, t, **changed):
        state = copy(self.body.read(t)[0])
        for name, value in changed.items():
            setattr(state, name, value)
        self.robot.transmit(t, state)
        self.robot.act(t)
        self.states.clear()
        self.telemetry.send_states(t)
        return self.states


@pytest.fixture
def reporter(monkeypatch):
    def publisher(_session, key, _mime):
        def put(payload):
            if key == KEYS.state("A"):
                made.states.append(messages.decode(payload, messages.JSON, messages.State))

        return SimpleNamespace(put=put)

    with network.Net().worn() as net:
        monkeypatch.setattr(pubsub, "publisher", publisher)
        made = Reporter(net.session)
        yield made


def test_blind_robot_reports_received_poses(reporter):
    reporter.receive(100)
    (state,) = reporter.report(0.02, position=UNKNOWN)
    assert (state.position, len(state.received)) == (None, 100)
    assert not reporter.inbox.unreported[0]
    (state,) = reporter.report(0.04, velocity=UNKNOWN)
    assert state.position is not None
    assert (state.velocity, state.received) == (None, [])
    (state,) = reporter.report(0.06, yaw=2000.0 * pi + 0.5, true_yaw=-2000.0 * pi + 0.5)
    assert (state.yaw, state.true_yaw) == pytest.approx((0.5, 0.5), abs=1e-9)


def test_waiting_receipts_are_bounded(reporter):
    reporter.receive(MAX_UNREPORTED + 500)
    assert len(reporter.inbox.unreported[0]) == MAX_UNREPORTED
    states = reporter.report(0.02)
    assert len(states) > 1
    assert [each.seq for state in states for each in state.received] == list(range(501, MAX_UNREPORTED + 501))
    assert {state.seq for state in states} == {1}


def test_sweep_as_a_message():
    scan = RangeScan(2.5, (0.0, 0.5, 1.0), (0.0,) * 3, (0.12345678, nan, 1.0))
    ranges = range_inbox.message("KH01", 1000.0, scan)
    assert ranges == messages.Ranges("KH01", 1002.5, [0.0, 0.5, 1.0], [0.0, 0.0, 0.0], [0.123457, None, 1.0])
    validation.check_ranges(ranges, now=1002.5)


def test_newest_sweep_is_known_until_old():
    net = network.Net()
    inbox = range_inbox.RangeInbox(net.session, KEYS, ("CF01", "KH01"), [1])

    def known(at, *distance, robot="KH01", stamp=None):
        """The sweep that is known at a time [s], after one of that time or `stamp` was received."""
        angles = [0.0] * len(distance)
        message = messages.Ranges(robot, UTC + (stamp or at), angles, angles, list(distance))
        if distance:
            net.deliver(sent(KEYS.ranges("KH01"), message)[0])
        return inbox.read(UTC, at)[1]

    assert known(10.0) is None
    first = known(10.0, 0.5, None)
    assert first.distance == pytest.approx((0.5, nan), nan_ok=True)
    assert first.time == pytest.approx(10.0, abs=1e-6)
    assert known(10.5) is first, "nothing new costs nothing"
    states = [BodyState(), BodyState()]
    inbox.replace_scans(states, UTC, 10.5)
    assert [state.scan for state in states] == [None, first]
    assert known(10.5, 0.7, 0.8, stamp=9.5) is first, "it was overtaken"
    assert known(10.5, 0.7, 0.8, robot="CF01") is first
    assert (inbox.malformed, inbox.trouble) == (1, "ranges of 'CF01' on the key of 'KH01'")
    assert known(10.5, 0.9, stamp=10.2).distance == (0.9,)
    assert known(11.3) is None, "a second later it says nothing of where things are"
