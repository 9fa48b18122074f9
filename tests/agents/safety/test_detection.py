"""Detection of hazards: each cause, when it is present, and its extent in words."""

import math
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.body.limits import Limits
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.situation import LATE_SHARE, SILENT_S, ProcessHealth, Situation
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins.predictors import HOLD
from agents.safety.detection import FOREIGN_S, LOWEST_DESCENT_M_S, Detector, RobotStatus, tilt_angle, tilted
from agents.safety.hazards import Cause, Hazards, Outcome
from agents.vectors import UNKNOWN, ZERO

DT, NAN = 0.01, math.nan


class Watched:
    """A robot that cruises at its place, with `neighbours` beside it, each a name and a kind."""

    def __init__(self, kind=CRAZYFLIE, neighbours=(), *, hover=0.5, avoids=False, **safety):
        limits = Limits(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.5), **safety)
        incoming = [Incoming(number, name, of, 0.5) for number, (name, of) in enumerate(neighbours)]
        assignment = SimpleNamespace(
            name="A", kind=kind, hover=hover, limits=limits, predictor=HOLD, avoidance="potential", avoids=avoids
        )
        self.avoids = avoids
        self.detector, self.hazards = Detector(assignment), Hazards(kind, limits)
        self.neighbours, self.health = Neighbours(incoming, limits.neighbour_timeout_s), ProcessHealth()
        self.now, self.status = Situation(), RobotStatus()
        self.status.cruising, self.status.goal_height = True, hover
        self.position, self.velocity, self.yaw = (0.0, 0.0, hover), (0.0, 0.0, 0.0), 0.0
        self.values = {"battery": 0.8, "flying": kind.flies}
        self.active, self.landing = True, False
        self.t, self.causes = 1.0, 0
        self.acts = []
        for link in range(len(incoming)):
            self.neighbours.mark_alive(link)
            self.hear(link, (1.0, float(link), hover))

    def hear(self, link, position):
        """Receive a pose of a neighbour."""
        self.neighbours.receive(link, position, (0.0, 0.0, 0.0), self.t, self.t)

    def step(self, seconds=DT, every_tick=None):
        """Let time pass; `every_tick` may change what the next tick finds."""
        for _ in range(round(seconds / DT)):
            if every_tick is not None:
                every_tick(self)
            self.neighbours.update_active(self.t)
            given = {"time": self.t, "received": self.t, **self.values}
            state = BodyState(position=self.position, velocity=self.velocity, yaw=self.yaw, **given)
            self.now.state = state
            self.detector.sees = self.detector.sees or (self.avoids and state.scan is not None)
            self.now.begin(self.t)
            self.causes = self.detector.causes(self.now, self.status, self.neighbours, self.health)
            if self.causes or self.hazards.under_way:
                self.acts += self.hazards.update(
                    self.t, self.causes, self.words, active=self.active, landing=self.landing
                )
            self.t += DT
        return self

    def words(self, cause):
        if cause == Cause.BELOW:
            return "B; it goes aside first"
        return self.detector.words(cause, self.now, self.status, self.neighbours, self.health)

    def measure(self, *, flags=None, **values):
        """Let the body measure values from now on; `flags`: what is judged of its pose, as in `Situation`."""
        for name in ("position", "velocity", "yaw"):
            setattr(self, name, values.pop(name, getattr(self, name)))
        self.values |= values
        if flags is not None:
            self.now.sound = False
            for name, value in flags.items():
                setattr(self.now, name, value)
        return self

    @property
    def found(self):
        """Causes of the last tick."""
        return {cause for cause in Cause if self.causes >> cause & 1}

    @property
    def texts(self):
        return [incident.text for incident in self.hazards.incidents]


def leant(angle):
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0


def mocap(seconds):
    return f"positions of A are stamped {seconds}"


def sinking(height, speed):
    return {"position": (0.0, 0.0, height), "velocity": (0.0, 0.0, -speed)}


def judged(**flags):
    return {"flags": flags}


CAUSES = {  # what is measured of a drone that cruises at 0.5 m: causes, and the extent of the first
    "tipped": ({"attitude": leant(1.3)}, {Cause.TILT}, "it leans 74° (limit 69°)"),
    "level enough": ({"attitude": leant(1.1)}, set(), ""),
    "upside down": ({"attitude": (0.0, 1.0, 0.0, 0.0)}, {Cause.TILT}, "it leans 180° (limit 69°)"),
    "unknown attitude": ({"attitude": (NAN,) * 4}, set(), ""),
    "empty": ({"battery": 0.09}, {Cause.BATTERY}, "9% (limit 10%)"),
    "no gauge": ({"battery": NAN}, set(), ""),
    "down": ({"flying": False}, {Cause.FALLEN}, "its motors are off"),
    "silent": ({"received": 0.4}, {Cause.UNREACHABLE}, "for 0.6 s"),
    "no device": ({"received": NAN}, set(), ""),
    "clock ahead": ({"ahead": 0.11}, {Cause.CLOCK}, mocap("0.11 s ahead")),
    "clock hardly ahead": ({"ahead": 0.1}, set(), ""),
    "clock behind": ({"ahead": -0.26}, {Cause.CLOCK}, mocap("0.26 s behind")),
    "clock hardly behind": ({"ahead": -0.25}, set(), ""),
    "too fast": ({"velocity": (0.0, 4.4, 0.0)}, {Cause.OVERSPEED}, "4.40 m/s (limit 4.33 m/s)"),
    "fast": ({"velocity": (0.0, 4.3, 0.0)}, set(), ""),
    "speed unknown": ({"velocity": UNKNOWN}, set(), ""),
    "sinks": (sinking(0.3, 0.2), {Cause.SINKING}, "0.20 m below its goal, and sinks at 0.20 m/s"),
    "low": (sinking(0.3, 0.1), set(), ""),
    "dips": (sinking(0.4, 0.2), set(), ""),
    "beyond": (judged(outside_wall=True, excess=0.1), {Cause.MARGIN}, "0.10 m outside (limit 0 m)"),
    "outside": (judged(outside_wall=True, outside=True, excess=0.3), {Cause.OUTSIDE}, "0.30 m outside (limit 0.25 m)"),
    "flown": (judged(outside=True, flyaway=True), {Cause.OUTSIDE, Cause.FAR_OUTSIDE}, "0.00 m outside (limit 0.25 m)"),
    "flipped": (judged(invalid=True, jump=0.7, yaw_jump=1.2), {Cause.POSITION}, "its yaw jumped by 1.20 rad"),
    "jumped": (judged(invalid=True, jump=0.7), {Cause.POSITION}, "it jumped by 0.70 m"),
    "stale": (judged(invalid=True), {Cause.POSITION}, "the last is 0.00 s old"),
    "early": (judged(invalid=True) | {"time": 1.3}, {Cause.POSITION}, "it is stamped 0.3 s ahead"),
    "lost": (judged(invalid=True) | {"position": UNKNOWN}, {Cause.POSITION}, "none"),
}


@pytest.mark.parametrize("what", CAUSES)
def test_causes_of_one_tick(what):
    measured, causes, extent = CAUSES[what]
    robot = Watched().measure(**measured)
    assert robot.step().found == causes
    assert [robot.words(cause) for cause in sorted(causes)][:1] == [extent][: len(causes)]


def test_wheels_have_no_causes_of_flight():
    robot = Watched(KHEPERA4, hover=NAN).measure(
        position=ZERO, velocity=(0.0, 0.0, -0.2), attitude=leant(2.0), flying=False, flags={"flyaway": True}
    )
    assert robot.step().found == set()


@pytest.mark.parametrize(("samples", "outcome"), [(1, Outcome.NONE), (2, Outcome.CUT)])
def test_lean_takes_two_samples(samples, outcome):
    robot = Watched().step()
    for _ in range(samples):  # telemetry that stops with the last one
        robot.values |= {"attitude": leant(1.4), "time": robot.t}
        robot.step()
    assert robot.step(0.3).hazards.outcome() == outcome


# ---------------------------------------------------------------- neighbours


@pytest.mark.parametrize(("kind", "touching"), [(KHEPERA4, 0.145), (TURTLEBOT3, 0.2)], ids=["small", "large"])
def test_robots_too_near_hold_nearer_land(kind, touching):
    robot = Watched(kind, [("B", kind), ("C", kind)], hover=0.0, separation=0.3)
    assert robot.step().found == set()
    robot.hear(1, (0.25, 0.0, 0.0))
    assert robot.step().found == {Cause.SEPARATION}
    assert robot.words(Cause.SEPARATION) == "0.25 m from C (limit 0.3 m)"
    robot.hear(1, (touching, 0.0, 0.0))
    assert robot.step().found == {Cause.SEPARATION, Cause.TOUCHING}
    robot.position = UNKNOWN
    assert robot.step().found == set()


def test_separation_needs_a_sender_that_is_there():
    robot = Watched(KHEPERA4, [("B", KHEPERA4)], hover=0.0, separation=0.3).step()
    robot.hear(0, (0.2, 0.0, 0.0))
    robot.neighbours.mark_lost(0, robot.t)
    assert Cause.SEPARATION in robot.step(1.0).found
    assert Cause.SEPARATION not in robot.step(0.02).found
    robot.neighbours.mark_alive(0)
    robot.neighbours.discard_pose(0)
    robot.status.alone = True
    assert robot.step().found == {Cause.ALONE}
    assert robot.words(Cause.ALONE) == "none was received"


def test_lost_neighbours():
    robot = Watched(KHEPERA4, [("B", KHEPERA4), ("C", KHEPERA4)], hover=0.0).step()
    robot.neighbours.mark_lost(0, robot.t)
    assert robot.step(1.0).found == set()
    assert robot.step(0.03).found == {Cause.NEIGHBOUR}
    assert robot.texts == ["warn: a neighbour is lost: B"]
    robot.neighbours.mark_lost(1, robot.t - 2.0)
    robot.status.alone = True
    assert robot.step().found == {Cause.NEIGHBOUR, Cause.ALONE}
    assert robot.words(Cause.ALONE) == "B, C"
    robot.status.cruising = False
    assert robot.step().found == set()


def test_poses_of_neighbours():
    robot = Watched(KHEPERA4, [("B", KHEPERA4), ("C", KHEPERA4)], hover=0.0).step()
    robot.neighbours.mark_clock_lag(1, 0.7)
    robot.neighbours.mark_refused(0, "it is outside the arena")
    robot.neighbours.mark_foreign(0, 3, robot.t)
    assert robot.step().found == {Cause.BEHIND, Cause.REFUSED, Cause.FOREIGN}
    assert robot.words(Cause.BEHIND) == "the poses of C are 0.7 s old when they arrive"
    assert robot.words(Cause.REFUSED) == "B: it is outside the arena"
    assert robot.words(Cause.FOREIGN) == "3 poses of B came from another source, and were not used"
    robot.neighbours.mark_clock_lag(1, 0.0)
    robot.neighbours.mark_refused(0, "")
    assert robot.step().found == {Cause.FOREIGN}
    assert robot.step(FOREIGN_S).found == set()


# ---------------------------------------------------------------- process


@pytest.mark.parametrize(
    ("given", "causes", "words"),
    [
        ({"ordered": True}, {Cause.ORDERED}, "by an operator"),
        ({"ordered": True, "unguided": True, "not_finite": True}, {Cause.ORDERED, Cause.SETPOINT, Cause.CENTRE}, None),
        (
            {"ordered": True, "unguided": True, "not_finite": True, "cruising": False},
            {Cause.ORDERED, Cause.CENTRE},
            None,
        ),
        ({"offline_since": -1.5}, {Cause.ROUTER}, "for 2.5 s"),
        ({"conductor_lost_since": -1.5}, {Cause.CONDUCTOR}, "for 2.5 s"),
        ({"missed_share": 0.95}, {Cause.LATE}, "95% of the last second's"),
    ],
)
def test_causes_of_orders_and_of_the_process(given, causes, words):
    robot = Watched()
    for name, value in given.items():
        setattr(robot.health if hasattr(robot.health, name) else robot.status, name, value)
    assert robot.step().found == causes
    assert words is None or robot.words(*causes) == words


def test_unstarted_drone_lands():
    robot = Watched(offline_s=3.0)
    robot.status.unstarted = True
    assert robot.step(3.0).found == set()
    robot.health.conductor_lost_since = robot.t
    robot.step(2.9)
    assert robot.acts == []
    robot.step(0.2)
    assert [each.text for each in robot.acts] == ["land: no start will come: the conductor is gone for 3.0 s"]


def test_failing_control_loop():
    health = ProcessHealth()

    def share(ticks, missed):
        for _ in range(ticks):
            health.count_tick(missed, DT)
        return health.missed_share

    assert share(500, missed=4) == pytest.approx(0.8)  # 20 Hz is slow, not hopeless
    assert share(1, missed=500) > LATE_SHARE  # 5 s of nothing
    assert share(20, missed=0) < LATE_SHARE
    assert share(2000, missed=0) == 0.0


@pytest.mark.parametrize("avoids", [True, False])
def test_range_sensors_that_fall_silent(avoids):
    robot = Watched(TURTLEBOT3, hover=0.0, avoids=avoids)
    assert robot.step(2.0).found == set()  # there was none yet
    ray = (0.0,)
    robot.values["scan"] = RangeScan(robot.t, ray, ray, ray)
    assert robot.step(0.5).found == set()
    robot.values["scan"] = RangeScan(robot.t, (), (), ())  # no reading
    assert robot.step(0.5).found == set()
    robot.values["scan"] = None
    robot.step(0.02)
    assert robot.texts == (["hold: its range sensors are silent: for 1.0 s"] if avoids else [])


# ---------------------------------------------------------------- a process that was suspended


def woken(slept=0.6, neighbours=(("B", KHEPERA4),)):
    """A robot with one neighbour, the process of which has just resumed."""
    robot = Watched(KHEPERA4, neighbours, hover=0.0).step(1.0)
    robot.health.mark_resumed(robot.t, slept)
    return robot


def held_s(robot, seconds):
    """Ticks on which a robot is held."""
    return sum(robot.step().hazards.held for _ in range(round(seconds / DT)))


def test_standstill_holds_until_neighbours_are_heard():
    robot = woken()
    assert held_s(robot, 0.03) == 3
    robot.hear(0, (1.0, 0.0, 0.0))
    assert held_s(robot, 3.0) == 0
    begin, end = robot.texts
    assert begin == "hold: its process stood still: for 0.6 s; it waits for its neighbours"
    assert end.startswith("over: its process stood still, after ")
    lost = woken()
    lost.neighbours.mark_lost(0, lost.t)
    assert held_s(lost, 0.5) == held_s(woken(neighbours=()), 0.5) == 0


@pytest.mark.parametrize("slept", [0.6, 1.5, 2.2])
def test_silent_neighbours_are_not_awaited_for_long(slept):
    assert held_s(woken(slept), 3.0) == pytest.approx(SILENT_S / DT, abs=1)


def test_waiting_begins_when_the_router_is_back():
    robot = woken()
    robot.health.offline_since = robot.t
    assert held_s(robot, 3.0) == 300
    robot.health.offline_since = math.inf
    assert held_s(robot, 3.0) == pytest.approx(SILENT_S / DT, abs=1)
    robot.health.offline_since = robot.t  # much later: that standstill is over
    assert held_s(robot, 0.5) == 0


def test_guided_robot_waits_for_a_new_goal():
    robot = woken(neighbours=())
    for goal_stamp, ticks in ((robot.t - 0.5, 10), (robot.t, 0)):
        robot.status.goal_stamp = goal_stamp
        assert held_s(robot, 0.1) == ticks


# ---------------------------------------------------------------- climbing and landing


def climbs(kind=CRAZYFLIE):
    robot = Watched(kind)
    robot.status.cruising, robot.status.climbing = False, True
    return robot


def test_climb_that_is_carried_aside():
    robot = climbs()

    def carry(robot):
        robot.position = (robot.t - 1.0, 0.0, 0.1 + robot.t - 1.0)

    assert robot.step(0.55, carry).texts == []
    robot.step(0.05, carry)
    assert robot.texts == ["land: it moves without a command: 0.57 m aside while it climbs"]
    robot.status.climbing = False
    assert robot.step().found == set()


@pytest.mark.parametrize(("kind", "patience_s"), [(CRAZYFLIE, 4.0), (TELLO, 10.0)], ids=["crazyflie", "tello"])
def test_climb_without_measured_height(kind, patience_s):
    robot = climbs(kind).measure(position=(0.0, 0.0, 0.02))
    assert robot.step(patience_s).texts == []
    assert robot.step(0.03).texts == ["land: it does not obey commands to move: it does not rise"]


def lands(**measured):
    """A drone that begins to land."""
    robot = Watched(landing_s=2.0).measure(**measured)
    robot.status.cruising, robot.status.landing = False, True
    robot.active, robot.landing = False, True
    return robot


@pytest.mark.parametrize(
    ("measured", "seconds"),
    [
        ({"position": (0.0, 0.0, 0.02)}, 2.0),
        ({"velocity": (0.0, 0.0, 0.5)}, 2.5),
        ({"position": (0.0, 0.0, NAN), "flags": {"invalid": True}}, 2.5 / LOWEST_DESCENT_M_S),  # of its room
    ],
    ids=["on the floor", "climbs", "blind"],
)
def test_landing_that_does_no_good_is_cut(measured, seconds):
    robot = lands(**measured).step(seconds + 1.9)
    assert robot.acts == []
    robot.step(0.2)
    assert [each.text for each in robot.acts] == ["cut: its landing takes too long: more than 2 s without a descent"]


def test_hovering_drone_is_never_cut():
    robot = lands().step(30.0)
    assert robot.texts == ["warn: it hovers although commanded to land: at 0.50 m"]
    assert robot.measure(flying=False).step().found == set()


def test_slow_landing_is_given_its_time():
    def sink(robot):
        robot.position = (0.0, 0.0, robot.position[2] - 0.03 * DT)

    assert lands(velocity=(0.0, 0.0, -0.03)).step(15.0, sink).texts == []


def test_robot_below_a_landing():
    robot = lands()
    robot.status.aside = True
    assert robot.step().texts == ["warn: a robot is below it: B; it goes aside first"]
    robot.status.landing = False
    assert robot.step().found == set()


@pytest.mark.parametrize(
    ("attitude", "angle"),
    [
        (leant(0.5), 0.5),
        ((math.cos(0.6), 0.0, 0.0, math.sin(0.6)), 0.0),  # turned
        ((0.0, 1.0, 0.0, 0.0), math.pi),
        *((no_rotation, None) for no_rotation in ((1.0, 0.7, 0.0, 0.0), (10.0, 0.8, 0.0, 0.0), (1e200,) * 4)),
        *(((number,) * 4, None) for number in (0.0, NAN)),
    ],
)
def test_tilt_is_an_angle_to_the_vertical(attitude, angle):
    assert tilted(attitude, 0.49) == (angle is not None and angle > 0.49)
    assert angle is None or tilt_angle(attitude) == pytest.approx(angle)
