"""A neighbour is alive by its token alone, and a new process of it is a new life."""

from __future__ import annotations

import random

import pytest
import zenoh

from agents.network import messages
from agents.network.channel_model import Conditions
from agents.network.keys import Keys
from agents.plugins.predictors import ConstantVelocity
from agents.robot import Robot as Decision
from agents.runtime.pose_inbox import LATE_S, PoseInbox
from agents.safety.detection import FOREIGN_S
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.fuzz.loopnet import Net, Payload

UTC, KEYS = 1.7e9, Keys()


class Source:
    def __init__(self, session: str) -> None:
        self.source_id, self.zid = self, session


class Sample:
    """What Zenoh hands out: of a token, or of a pose from a session."""

    timestamp = attachment = None
    encoding = messages.JSON

    def __init__(self, key: str, payload: bytes = b"", *, gone: bool = False, session: str | None = None) -> None:
        self.key_expr, self.payload = key, Payload(payload)
        self.kind = zenoh.SampleKind.DELETE if gone else zenoh.SampleKind.PUT
        self.source_info = None if session is None else Source(session)


class Robot:
    """A, alone in its process, and B, of which the test says everything."""

    def __init__(self, net: Net, conditions: Conditions | None = None) -> None:
        self.net, self.decision = net, Decision(Plan(pair()).assignment("A"))
        self.inbox = PoseInbox(
            net.session,
            KEYS,
            [self.decision],
            valid_box=(5.0, 5.0, 5.0),
            conditions=[[conditions]] if conditions else (),
        )
        (self.neighbour,) = self.decision.neighbours.all
        (self.sender,) = self.inbox.senders
        self.t = 0.0

    def tell(self, key: str, **what: object) -> None:
        for channel in self.net.channels:
            if channel.expression.intersects(zenoh.KeyExpr(key)):
                channel.add(Sample(key, **what))

    def pose(self, seq: int, x: float, *, session: str | None, age: float = 0.0, speed: float = 0.0) -> None:
        said = messages.pose("B", seq, UTC + self.t - age, [x, 0.0, 0.0], [speed, 0.0, 0.0], yaw=0.0)
        self.tell(KEYS.pose("B"), payload=messages.encode(said), session=session)

    def token(self, session: str | None, *, gone: bool = False) -> None:
        """The tokens of B, as they come and go together."""
        if session is not None:
            self.tell(Keys.life(KEYS.alive("B"), session), gone=gone)
        self.tell(KEYS.alive("B"), gone=gone)

    def begin(self, session: str | None, seq: int = 1) -> None:
        """A process of B takes the name and sends its first pose."""
        self.token(session)
        self.pose(seq, 0.4, session=session)
        self.after()

    def after(self, seconds: float = 0.02) -> None:
        self.inbox.deliver(self.t, UTC)
        self.decision.goals.update_links(self.t)
        self.t += seconds

    @property
    def live(self) -> bool:
        """Whether B takes part in the law."""
        return self.neighbour.active

    @property
    def x(self) -> float:
        return self.neighbour.position[0]


@pytest.fixture
def robot():
    with Net().worn() as net:
        yield Robot(net)


def test_pose_without_a_token_is_not_believed(robot):
    robot.pose(1, 0.4, session="one")  # the last value of a robot that has landed, and has taken its token back
    robot.after(5.0)
    robot.after()
    assert not robot.live
    assert robot.decision.missing_neighbours() == ["B"]
    assert robot.decision.neighbours.unreceived()
    robot.token("one")
    robot.after()
    assert robot.live
    assert robot.decision.missing_neighbours() == []
    assert robot.x == 0.4


def test_late_sample_revives_nobody(robot):
    robot.begin("one")
    robot.token("one", gone=True)
    robot.after(4.0)
    robot.pose(2, 0.5, session="one", age=2.5)
    robot.after()
    assert not robot.live
    assert robot.decision.missing_neighbours() == ["B"]
    robot.after(500.0)
    robot.after()
    assert not robot.live


@pytest.mark.parametrize("behind_s", [1.0, 60.0, -3.0])
def test_restarted_neighbour_is_received_at_once(robot, behind_s):
    robot.token("one")
    for seq in range(1, 100):
        robot.pose(seq, 0.4, session="one", age=min(0.0, behind_s))
        robot.after()
    robot.token("one", gone=True)
    robot.after(2.0)
    robot.token("two")
    robot.after()
    assert not robot.live  # where the former process was is not where this one is
    assert robot.decision.missing_neighbours() == ["B"]
    robot.pose(1, -0.4, session="two", age=max(0.0, behind_s))
    robot.after()
    assert robot.live
    assert robot.x == -0.4
    assert robot.sender.lost == 0
    robot.pose(100, 0.4, session="one")  # held back by the network since the first life
    robot.after()
    assert robot.x == -0.4
    assert robot.sender.foreign == 1


def test_reconnected_neighbour_is_where_it_was(robot):
    robot.begin("one", 7)
    robot.token("one", gone=True)
    robot.after(2.0)
    assert robot.live  # known so far to be gone for no time at all
    robot.after()
    assert not robot.live
    robot.token("one")
    robot.after()
    assert robot.live
    assert robot.x == 0.4


def test_other_make_begins_anew_with_its_token(robot):
    robot.begin(None, 7)
    robot.token(None, gone=True)
    robot.after(1.0)
    robot.token(None)
    robot.pose(1, 0.3, session=None, age=30.0)
    robot.after()
    assert (robot.live, robot.x) == (True, 0.3)
    robot.pose(2, 0.2, session=None, age=90.0)  # its clock steps while it runs: the number says that it is newer
    robot.after()
    assert robot.x == 0.2
    robot.pose(1, 0.9, session=None, age=95.0)
    robot.after()
    assert (robot.x, robot.sender.stale) == (0.2, 1)


def test_other_sessions_do_not_replace_the_robot(robot):
    robot.begin("one")
    for source in ("other", None):  # another process, or a tool that puts old poses again
        robot.pose(9, 3.0, session=source)
        robot.pose(10, 3.0, session=source, age=100.0)
        robot.after()
    assert (robot.x, robot.sender.foreign) == (0.4, 4)


def test_superseded_session_is_received_again(robot):
    robot.begin("one", 7)
    robot.token("one", gone=True)  # it stands still
    robot.after(2.0)
    robot.token("two")  # a second process of its name comes,
    robot.pose(1, 0.9, session="two")
    robot.after()
    assert robot.x == 0.9
    robot.token("two", gone=True)  # and goes
    robot.after(2.0)
    robot.token("one")
    robot.pose(8, 0.5, session="one")
    robot.after()
    assert (robot.live, robot.x, robot.sender.foreign) == (True, 0.5, 0)
    robot.pose(2, 0.9, session="two")  # held back by the network
    robot.after()
    assert (robot.x, robot.sender.foreign) == (0.5, 1)


@pytest.mark.parametrize("first", ["owner", "loser"])
def test_remaining_one_of_two_claims_is_received(robot, first):
    second = {"owner": "loser", "loser": "owner"}[first]
    for session in (first, second):
        robot.tell(Keys.life(KEYS.alive("B"), session))
    robot.after()
    robot.tell(Keys.life(KEYS.alive("B"), "loser"), gone=True)
    robot.tell(KEYS.alive("B"))
    robot.pose(1, 0.4, session="owner")
    robot.after()
    assert (robot.live, robot.x, robot.sender.foreign) == (True, 0.4, 0)


def test_returning_session_displaces_nobody(robot):
    robot.token("two")
    robot.pose(1, 0.4, session="two")
    robot.after()
    robot.tell(Keys.life(KEYS.alive("B"), "one"))  # it was cut off, and will give way
    robot.pose(900, 0.9, session="one")
    robot.pose(2, 0.5, session="two")
    robot.after()
    assert (robot.x, robot.sender.foreign) == (0.5, 1)


def test_restarted_robot_leaves_the_law(robot):
    robot.token("one")
    robot.pose(7, 0.4, session="one", speed=0.3)
    robot.after()
    robot.token("one", gone=True)
    robot.after(5.0)
    robot.tell(Keys.life(KEYS.alive("B"), "two"))  # its body is opened, which takes a minute, or fails
    robot.after(60.0)
    robot.after()
    assert not robot.live
    assert robot.decision.missing_neighbours() == ["B"]
    assert (robot.x, believed(robot)) == (0.4, 0.4)
    assert robot.neighbour.silent
    robot.tell(KEYS.alive("B"))
    robot.after()
    assert (robot.live, robot.x) == (False, 0.4)
    robot.pose(1, -0.2, session="two")
    robot.after()
    assert (robot.live, robot.x) == (True, -0.2)
    assert not robot.neighbour.silent


@pytest.mark.parametrize("source", [None, "storage"])
def test_stored_pose_before_the_first_token_is_void(robot, source):
    robot.pose(5000, 0.9, session=source, age=600.0)  # the answer of a storage to the first query
    robot.after()
    robot.token("one")
    robot.after()
    assert not robot.live
    assert robot.decision.missing_neighbours() == ["B"]
    robot.pose(1, 0.4, session="one")
    robot.after()
    assert (robot.live, robot.x, robot.sender.lost) == (True, 0.4, 0)


def test_cached_pose_of_the_session_is_kept(robot):
    robot.pose(7, 0.4, session="one", age=20.0)  # the answer of its own cache, before the token
    robot.token("one")
    robot.after()
    assert (robot.live, robot.x) == (True, 0.4)


def test_after_reconnection_tokens_may_come_in_any_order(robot):
    robot.begin("one", 7)
    robot.token("one", gone=True)
    robot.after()
    robot.tell(KEYS.alive("B"))
    robot.pose(9000, 0.9, session=None, age=100.0)
    robot.after()
    robot.tell(Keys.life(KEYS.alive("B"), "one"))
    robot.pose(8, 0.5, session="one")
    robot.after()
    assert (robot.live, robot.x) == (True, 0.5)


def test_new_process_before_its_token_is_received(robot):
    robot.begin("one", 7)
    robot.token("one", gone=True)  # the router dies; meanwhile B is restarted
    robot.after(3.0)
    robot.pose(1, 0.6, session="two")
    robot.after()
    robot.token("two")
    robot.after()
    assert (robot.live, robot.x) == (True, 0.6)


def test_robot_of_another_make_may_take_the_name(robot):
    robot.begin("one", 7)
    robot.token("one", gone=True)
    robot.after(3.0)
    robot.token(None)
    robot.pose(1, 0.6, session=None)
    robot.after()
    assert (robot.live, robot.x) == (True, 0.6)


@pytest.mark.parametrize("sends", [True, False])
def test_neighbour_whose_poses_are_all_refused_is_lost(robot, sends):
    robot.begin("one")
    for seq in range(2, 72):
        if sends:
            robot.pose(seq, 0.4, session="one", age=-8.0)  # this process, or that one, has a wrong clock
        robot.pose(seq, 0.4, session="other", age=-8.0)  # which says nothing about B
        robot.after()
    assert (robot.decision.missing_neighbours() == ["B"]) == sends
    assert hazards(robot) == ["refused"] * sends + ["70 foreign"]
    assert robot.inbox.malformed == 70 * sends
    robot.pose(90, 0.4, session="one")
    robot.after()
    robot.after(1.0)
    assert robot.live
    assert robot.decision.missing_neighbours() == []
    assert hazards(robot) == []


def hazards(robot: Robot) -> list[str]:
    """What the checks of safety find in its neighbours."""
    neighbours, sender, found = robot.decision.neighbours, robot.neighbour, []
    if neighbours.lagging:
        found.append(f"behind by {sender.behind:.1f} s")
    if neighbours.refused:
        found.append("refused")
    if robot.t - neighbours.foreign_at < FOREIGN_S:
        found.append(f"{sender.foreign} foreign")
    return found


def test_poses_that_are_always_old_are_a_hazard(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=60.0)  # the last value of a robot that is silent: no proof
    robot.after()
    assert hazards(robot) == []
    for seq in range(2, 5):
        robot.pose(seq, 0.4, session="one", age=LATE_S + 1.0)
        robot.after()
    assert hazards(robot) == ["behind by 4.0 s"]
    robot.pose(9, 0.4, session="one")
    robot.after()
    assert hazards(robot) == []


def test_waiting_poses_prove_no_slow_clock(robot):
    robot.token("one")
    robot.t = 100.0
    for seq in range(1, 8):
        robot.pose(seq, 0.4, session="one", age=10.0 - seq)
    robot.after()
    assert hazards(robot) == []


def believed(robot: Robot) -> float:
    """Where B is believed to be now by a predictor without a horizon, x [m]."""
    return robot.neighbour.place(ConstantVelocity(), robot.t)[0]


@pytest.fixture(params=[0.0, 5.0])
def delayed(request):
    """A robot behind a modelled network, and its delay [s]."""
    conditions = Conditions(delay=request.param)
    with Net().worn() as net:
        yield Robot(net, conditions), request.param


def test_slow_clock_carries_no_pose_far(delayed):
    robot, delay = delayed
    robot.token("one")
    for seq in range(1, 5):
        robot.pose(seq, 0.4, session="one", age=60.0, speed=0.1)
        robot.after(0.1)
    robot.t += delay
    robot.after(0.0)
    # the last pose came 0.1 s and the delay ago: a minute would have put it 6 m away
    assert believed(robot) == pytest.approx(0.4 + 0.1 * (LATE_S + 0.1 + delay), abs=1e-5)
    assert hazards(robot) == ["behind by 60.0 s"]
    robot.t += 1.0
    assert believed(robot) == pytest.approx(0.4 + 0.1 * (LATE_S + 1.1 + delay), abs=1e-5)
    robot.pose(5, 0.7, session="one", age=0.5, speed=0.1)  # its clock was set right
    robot.after(delay)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.7 + 0.1 * (0.5 + delay), abs=1e-5)


def test_slow_clock_is_noticed_at_the_second_pose(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=60.0, speed=0.1)
    robot.after(0.1)
    robot.pose(2, 0.4, session="one", age=60.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.4 + 0.1 * LATE_S, abs=1e-5)
    assert hazards(robot) == []


def test_restart_with_slow_clock_is_noticed_at_once(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", speed=0.1)
    robot.after(0.1)
    robot.token("one", gone=True)
    robot.token("two")
    robot.pose(1, 0.4, session="two", age=60.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.4 + 0.1 * LATE_S, abs=1e-5)


def test_last_value_while_cut_off_is_extrapolated(robot):
    robot.token("one")
    robot.pose(1, 0.1, session="one", speed=0.1)
    robot.after(0.1)
    robot.t += 30.0
    robot.pose(2, 0.4, session="one", age=20.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(2.4, abs=1e-5)


def test_last_value_of_a_silent_robot_is_extrapolated(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=20.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(2.4, abs=1e-5)


@pytest.mark.parametrize("ahead", [0.2, 4.0])
def test_pose_stamped_ahead_counts_from_arrival(robot, ahead):
    robot.token("one")
    robot.t = 7.0
    robot.pose(1, 0.4, session="one", age=-ahead, speed=0.1)
    robot.after(0.0)
    assert (robot.neighbour.stamp, robot.neighbour.arrival) == pytest.approx((7.0, 7.0), abs=1e-5)
    robot.t += 2.0
    assert believed(robot) == pytest.approx(0.6, abs=1e-5), "two seconds old, not younger"
    (news,) = robot.inbox.unreported[0]
    assert news.stamp == pytest.approx(UTC + 7.0 + ahead), "recorded as it was stamped"


def test_replay_is_a_hazard_with_its_number(robot):
    robot.begin("one")
    robot.pose(9000, 3.0, session=None, age=100.0)
    robot.after()
    assert hazards(robot) == ["1 foreign"]
    robot.t += 1.0
    assert hazards(robot) == []
    assert robot.x == 0.4


@pytest.mark.parametrize("seed", range(60))
def test_remaining_process_is_received_after_any_turmoil(robot, seed):
    chance = random.Random(seed)
    alive: set[str] = set()
    names, seqs = ("one", "two", "three", "four"), dict.fromkeys(("one", "two", "three", "four"), 0)
    clocks = {name: chance.choice([0.0, 0.0, 60.0, -4.0, -9.0, 3600.0]) for name in names}
    plain = False

    def speak(name: str, x: float) -> None:
        seqs[name] += 1
        robot.pose(seqs[name], x, session=name, age=clocks[name])

    for _ in range(120):
        name, what = chance.choice(names), chance.randrange(7)
        if what == 0 or (what == 1 and name in alive):
            alive ^= {name}
            robot.tell(Keys.life(KEYS.alive("B"), name), gone=name not in alive)
        elif what == 2:
            plain = not plain
            robot.tell(KEYS.alive("B"), gone=not plain)
        elif what == 3:
            robot.pose(chance.randrange(1, 9000), 0.9, session=None, age=chance.choice([0.0, 500.0]))
        elif what == 4:
            clocks[name] = chance.choice([0.0, 30.0, -3.0])  # its clock steps
        else:
            speak(name, 0.8)
        robot.after(chance.choice([0.0, 0.02, 2.0]))
    for name in sorted(alive - {"one"}):
        robot.tell(Keys.life(KEYS.alive("B"), name), gone=True)
    if "one" not in alive:
        robot.tell(Keys.life(KEYS.alive("B"), "one"))
    if not plain:
        robot.tell(KEYS.alive("B"))
    robot.after(0.02)
    clocks["one"] = 0.0
    for _ in range(2):
        speak("one", 0.4)
        robot.after(0.02)
    robot.pose(9999, 0.9, session=None)
    robot.pose(9999, 0.9, session="two")
    robot.after()
    assert (robot.live, robot.x) == (True, 0.4)
    assert robot.decision.missing_neighbours() == []
