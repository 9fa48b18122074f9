"""A neighbour is alive by its token alone, and a new process of it is a new life."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from agents.agent import Agent
from agents.network import messages
from agents.network.channel_model import Conditions
from agents.network.keys import Keys
from agents.plugins.predictors import ConstantVelocity
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
        self.net, self.agent = net, Agent(Plan(pair()).assignment(("A",)))
        self.neighbours = PoseInbox(net.session, KEYS, self.agent, reach=(5.0, 5.0, 5.0), conditions=conditions)
        (self.sender,) = self.neighbours.senders
        self.t = 0.0

    def tell(self, key: str, **what: object) -> None:
        for channel in self.net.channels:
            if channel.expression.intersects(zenoh.KeyExpr(key)):
                channel.add(Sample(key, **what))

    def pose(self, seq: int, x: float, *, session: str | None, age: float = 0.0, speed: float = 0.0) -> None:
        said = messages.pose("B", seq, UTC + self.t - age, [x, 0.0, 0.0], [speed, 0.0, 0.0], 0.0)
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
        self.neighbours.deliver(self.t, UTC)
        self.agent.goal_computer.update_links(self.t)
        self.t += seconds

    @property
    def live(self) -> bool:
        """Whether B takes part in the law."""
        return len(self.agent.neighbours.active) == 1

    @property
    def x(self) -> float:
        return float(self.agent.neighbours.poses.position[0, 0])


@pytest.fixture
def robot():
    with Net().worn() as net:
        yield Robot(net)


def test_a_pose_without_a_token_is_not_believed(robot):
    robot.pose(1, 0.4, session="one")  # the last value of a robot that has landed, and has taken its token back
    robot.after(5.0)
    robot.after()
    assert not robot.live
    assert robot.agent.missing_neighbours(0) == ["B"]
    assert robot.agent.assignment.unreceived(robot.agent.neighbours.stamp_once_alive).all()
    robot.token("one")
    robot.after()
    assert robot.live
    assert robot.agent.missing_neighbours(0) == []
    assert robot.x == 0.4


def test_a_late_sample_revives_nobody(robot):
    robot.begin("one")
    robot.token("one", gone=True)
    robot.after(4.0)
    robot.pose(2, 0.5, session="one", age=2.5)
    robot.after()
    assert not robot.live
    assert robot.agent.missing_neighbours(0) == ["B"]
    robot.after(500.0)
    robot.after()
    assert not robot.live


@pytest.mark.parametrize("behind_s", [1.0, 60.0, -3.0])
def test_a_neighbour_that_is_restarted_is_heard_at_once_whatever_its_clock_says(robot, behind_s):
    robot.token("one")
    for seq in range(1, 100):
        robot.pose(seq, 0.4, session="one", age=min(0.0, behind_s))
        robot.after()
    robot.token("one", gone=True)
    robot.after(2.0)
    robot.token("two")
    robot.after()
    assert not robot.live  # where the former process was is not where this one is
    assert robot.agent.missing_neighbours(0) == ["B"]
    robot.pose(1, -0.4, session="two", age=max(0.0, behind_s))
    robot.after()
    assert robot.live
    assert robot.x == -0.4
    assert robot.sender.lost == 0
    robot.pose(100, 0.4, session="one")  # held back by the network since the first life
    robot.after()
    assert robot.x == -0.4
    assert robot.sender.foreign == 1


def test_a_neighbour_that_was_cut_off_is_believed_where_it_was(robot):
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


def test_a_robot_of_another_make_begins_anew_with_its_token_or_with_a_clock_that_is_set_back(robot):
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


def test_no_other_session_speaks_for_a_robot_whose_token_is_there(robot):
    robot.begin("one")
    for source in ("other", None):  # another process, or a tool that puts old poses again
        robot.pose(9, 3.0, session=source)
        robot.pose(10, 3.0, session=source, age=100.0)
        robot.after()
    assert (robot.x, robot.sender.foreign) == (0.4, 4)


def test_superseded_session_is_heard_again(robot):
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
def test_of_two_claims_the_one_that_stays_is_heard(robot, first):
    second = {"owner": "loser", "loser": "owner"}[first]
    for session in (first, second):
        robot.tell(Keys.life(KEYS.alive("B"), session))
    robot.after()
    robot.tell(Keys.life(KEYS.alive("B"), "loser"), gone=True)
    robot.tell(KEYS.alive("B"))
    robot.pose(1, 0.4, session="owner")
    robot.after()
    assert (robot.live, robot.x, robot.sender.foreign) == (True, 0.4, 0)


def test_session_that_returns_does_not_displace_the_present_one(robot):
    robot.token("two")
    robot.pose(1, 0.4, session="two")
    robot.after()
    robot.tell(Keys.life(KEYS.alive("B"), "one"))  # it was cut off, and will give way
    robot.pose(900, 0.9, session="one")
    robot.pose(2, 0.5, session="two")
    robot.after()
    assert (robot.x, robot.sender.foreign) == (0.5, 1)


def test_restarted_robot_keeps_its_place_and_leaves_the_law(robot):
    robot.token("one")
    robot.pose(7, 0.4, session="one", speed=0.3)
    robot.after()
    robot.token("one", gone=True)
    robot.after(5.0)
    robot.tell(Keys.life(KEYS.alive("B"), "two"))  # its body is opened, which takes a minute, or fails
    robot.after(60.0)
    robot.after()
    assert not robot.live
    assert robot.agent.missing_neighbours(0) == ["B"]
    assert (robot.x, believed_of_all(robot)) == (0.4, 0.4)
    assert robot.agent.neighbours.poses.silent.all()
    robot.tell(KEYS.alive("B"))
    robot.after()
    assert (robot.live, robot.x) == (False, 0.4)
    robot.pose(1, -0.2, session="two")
    robot.after()
    assert (robot.live, robot.x) == (True, -0.2)
    assert not robot.agent.neighbours.poses.silent.any()


def believed_of_all(robot: Robot) -> float:
    return float(robot.agent.neighbours.extrapolate_all(ConstantVelocity(), robot.t)[0, 0])


@pytest.mark.parametrize("source", [None, "storage"])
def test_stored_pose_before_the_first_token_is_void(robot, source):
    robot.pose(5000, 0.9, session=source, age=600.0)  # the answer of a storage to the first query
    robot.after()
    robot.token("one")
    robot.after()
    assert not robot.live
    assert robot.agent.missing_neighbours(0) == ["B"]
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


def test_new_process_is_heard_although_its_token_comes_later(robot):
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
    assert (robot.agent.missing_neighbours(0) == ["B"]) == sends
    assert [text.split(": ")[:2] for text in hazards(robot)] == ([["REFUSED", "B"]] if sends else []) + [
        ["FOREIGN", "70 poses of B came from another source, and were not used"]
    ]
    assert robot.neighbours.malformed == 70 * sends
    robot.pose(90, 0.4, session="one")
    robot.after()
    robot.after(1.0)
    assert robot.live
    assert robot.agent.missing_neighbours(0) == []
    assert hazards(robot) == []


def hazards(robot: Robot) -> list[str]:
    agent = robot.agent
    lag, refused = agent.neighbours.clock_lag, agent.neighbours.refused
    seen = [] if lag is None else list(agent._detector._lagging(agent.neighbours, lag))
    seen += list(agent._detector._refused_poses(refused)) if refused else []
    if robot.t - agent.neighbours.foreign_at < FOREIGN_S:
        seen += agent._detector._foreign_poses(agent.neighbours.foreign)
    return [f"{each.cause.name}: {each.detail(0)}" for each in seen if each.rows[0]]


def test_poses_that_are_always_older_than_a_network_delays_them_are_a_hazard(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=60.0)  # the last value of a robot that is silent: no proof
    robot.after()
    assert hazards(robot) == []
    for seq in range(2, 5):
        robot.pose(seq, 0.4, session="one", age=LATE_S + 1.0)
        robot.after()
    assert hazards(robot) == ["BEHIND: the poses of B are 4.0 s old when they arrive"]
    robot.pose(9, 0.4, session="one")
    robot.after()
    assert hazards(robot) == []


def test_what_waited_while_the_listener_stood_still_is_no_proof_of_a_slow_clock(robot):
    robot.token("one")
    robot.t = 100.0
    for seq in range(1, 8):
        robot.pose(seq, 0.4, session="one", age=10.0 - seq)
    robot.after()
    assert hazards(robot) == []


def believed(robot: Robot) -> float:
    """Where B is believed to be now by a predictor without a horizon, x [m]."""
    heard, predictor = robot.agent.neighbours.poses, ConstantVelocity()
    place = heard.extrapolate_position(predictor, robot.t, np.array([0]))
    np.testing.assert_array_equal(robot.agent.neighbours.extrapolate_all(predictor, robot.t), place)
    return float(place[0, 0])


@pytest.fixture(params=[0.0, 5.0])
def delayed(request):
    """A robot behind a modelled network, and its delay [s]."""
    conditions = replace(Conditions.ideal(1), delay=np.array([request.param]))
    with Net().worn() as net:
        yield Robot(net, conditions), request.param


def test_a_clock_that_is_behind_carries_no_pose_further_than_a_network_can_be_late(delayed):
    robot, delay = delayed
    robot.token("one")
    for seq in range(1, 5):
        robot.pose(seq, 0.4, session="one", age=60.0, speed=0.1)
        robot.after(0.1)
    robot.t += delay
    robot.after(0.0)
    # the last pose came 0.1 s and the delay ago: a minute would have put it 6 m away
    assert believed(robot) == pytest.approx(0.4 + 0.1 * (LATE_S + 0.1 + delay), abs=1e-5)
    assert hazards(robot) == ["BEHIND: the poses of B are 60.0 s old when they arrive"]
    robot.t += 1.0
    assert believed(robot) == pytest.approx(0.4 + 0.1 * (LATE_S + 1.1 + delay), abs=1e-5)
    robot.pose(5, 0.7, session="one", age=0.5, speed=0.1)  # its clock was set right
    robot.after(delay)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.7 + 0.1 * (0.5 + delay), abs=1e-5)


def test_a_clock_that_is_behind_is_not_followed_from_the_second_pose_on(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=60.0, speed=0.1)
    robot.after(0.1)
    robot.pose(2, 0.4, session="one", age=60.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.4 + 0.1 * LATE_S, abs=1e-5)
    assert hazards(robot) == []


def test_a_robot_that_begins_anew_with_a_clock_that_is_behind_is_not_followed_from_the_first_pose_on(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", speed=0.1)
    robot.after(0.1)
    robot.token("one", gone=True)
    robot.token("two")
    robot.pose(1, 0.4, session="two", age=60.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(0.4 + 0.1 * LATE_S, abs=1e-5)


def test_the_last_value_that_was_said_while_the_listener_was_cut_off_is_carried_on_to_now(robot):
    robot.token("one")
    robot.pose(1, 0.1, session="one", speed=0.1)
    robot.after(0.1)
    robot.t += 30.0
    robot.pose(2, 0.4, session="one", age=20.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(2.4, abs=1e-5)


def test_the_last_value_of_a_robot_that_is_silent_is_carried_on_to_now(robot):
    robot.token("one")
    robot.pose(1, 0.4, session="one", age=20.0, speed=0.1)
    robot.after(0.0)
    assert believed(robot) == pytest.approx(2.4, abs=1e-5)


@pytest.mark.parametrize("ahead", [0.2, 4.0])
def test_a_pose_that_is_stamped_ahead_was_measured_when_it_arrived(robot, ahead):
    robot.token("one")
    robot.t = 7.0
    robot.pose(1, 0.4, session="one", age=-ahead, speed=0.1)
    robot.after(0.0)
    heard = robot.agent.neighbours.poses
    assert (heard.stamp[0], heard.arrival[0]) == pytest.approx((7.0, 7.0), abs=1e-5)
    robot.t += 2.0
    assert believed(robot) == pytest.approx(0.6, abs=1e-5), "two seconds old, not younger"
    (news,) = robot.neighbours.news[0]
    assert news.stamp == pytest.approx(UTC + 7.0 + ahead), "recorded as it was stamped"


def test_replay_on_the_key_is_a_hazard_with_its_number(robot):
    robot.begin("one")
    robot.pose(9000, 3.0, session=None, age=100.0)
    robot.after()
    assert hazards(robot) == ["FOREIGN: 1 poses of B came from another source, and were not used"]
    robot.t += 1.0
    assert hazards(robot) == []
    assert robot.x == 0.4


@pytest.mark.parametrize("seed", range(60))
def test_after_any_turmoil_the_process_that_stays_is_heard(robot, seed):
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
    assert robot.agent.missing_neighbours(0) == []
