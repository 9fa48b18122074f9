"""Detection of hazards: each cause and its extent in words; and checks before take-off."""

import math
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.body.limits import LOWEST_DESCENT_M_S, Limits
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.situation import LATE_SHARE, SILENT_S, ProcessHealth, Situation
from agents.plugins.predictors import HOLD
from agents.safety.detection import FOREIGN_S, Detector, RobotStatus, tilt_angle, tilted
from agents.safety.hazards import Cause, Hazards, Outcome
from agents.safety.preflight import FRAME, LOST_S, Preflight
from agents.safety.setpoint_filter import SetpointFilter
from agents.vectors import UNKNOWN, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3

DT, NAN = 0.01, math.nan


class Watched:
    """A robot that cruises at its place, with `neighbours` of its kind beside it, one by letter."""

    def __init__(self, kind=CRAZYFLIE, neighbours="", *, avoids=False, **safety):
        self.kind, self.avoids, hover = kind, avoids, 0.5 if kind.flies else 0.0
        limits = Limits(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.5), **safety)
        assignment = SimpleNamespace(
            name="A", kind=kind, hover=hover, limits=limits, predictor=HOLD, avoidance="potential", avoids=avoids
        )
        incoming = [Incoming(number, name, kind, 0.5) for number, name in enumerate(neighbours)]
        self.detector, self.hazards, self.limits = Detector(assignment), Hazards(kind, limits), limits
        self.neighbours, self.health = Neighbours(incoming, limits.neighbour_timeout_s), ProcessHealth()
        self.now, self.status = Situation(), RobotStatus()
        self.status.cruising, self.status.goal_height = True, hover
        self.values = {"position": (0.0, 0.0, hover), "velocity": ZERO, "yaw": 0.0, "flying": kind.flies}
        self.t, self.causes, self.acts = 1.0, 0, []
        for link in range(len(incoming)):
            self.neighbours.mark_alive(link)
            self.hear(link, (1.0, float(link), hover))

    def hear(self, link, position):
        self.neighbours.receive(link, position, ZERO, self.t, self.t)

    def step(self, seconds=DT, every_tick=None):
        """Let time pass; `every_tick` may change what the next tick finds."""
        for _ in range(round(seconds / DT)):
            if every_tick is not None:
                every_tick(self)
            self.neighbours.update_active(self.t)
            state = BodyState(**{"time": self.t, "received": self.t, "battery": 0.8, **self.values})
            self.now.state = state
            if self.avoids:
                self.detector.notice(state.scan)
            self.now.begin(self.t)
            self.causes = self.detector.causes(self.now, self.status, self.neighbours, self.health)
            if self.causes or self.hazards.under_way:
                lands = self.status.landing
                acts = self.hazards.update(self.t, self.causes, self.words, active=not lands, landing=lands)
                self.acts += [each.text for each in acts]
            self.t += DT
        return self

    def words(self, cause):
        if cause == Cause.BELOW:
            return "B; it goes aside first"
        return self.detector.words(cause, self.now, self.status, self.neighbours, self.health)

    def measure(self, *, flags=None, **values):
        """Let the body measure values from now on; `flags`: what is judged of its pose, as in `Situation`."""
        self.values |= values
        self.now.sound = self.now.sound and flags is None
        for name, value in (flags or {}).items():
            setattr(self.now, name, value)
        return self

    @property
    def found(self):
        return {cause for cause in Cause if self.causes >> cause & 1}

    @property
    def texts(self):
        return [incident.text for incident in self.hazards.incidents]


def leant(angle):
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0


def sinking(height, speed):
    return {"position": (0.0, 0.0, height), "velocity": (0.0, 0.0, -speed)}


def judged(**flags):
    return {"flags": flags}


MOCAP = "positions of A are stamped "
CAUSES = {  # what is measured of a drone that cruises at 0.5 m: causes, and the extent of the first
    "tipped": ({"attitude": leant(1.3)}, {Cause.TILT}, "it leans 74° (limit 69°)"),
    "level enough": ({"attitude": leant(1.1)}, set(), ""),
    "unknown attitude": ({"attitude": (NAN,) * 4}, set(), ""),
    "empty": ({"battery": 0.09}, {Cause.BATTERY}, "9% (limit 10%)"),
    "no gauge": ({"battery": NAN}, set(), ""),
    "down": ({"flying": False}, {Cause.FALLEN}, "its motors are off"),
    "silent": ({"received": 0.4}, {Cause.UNREACHABLE}, "for 0.6 s"),
    "no device": ({"received": NAN}, set(), ""),
    "clock ahead": ({"ahead": 0.11}, {Cause.CLOCK}, MOCAP + "0.11 s ahead"),
    "clock hardly ahead": ({"ahead": 0.1}, set(), ""),
    "clock behind": ({"ahead": -0.26}, {Cause.CLOCK}, MOCAP + "0.26 s behind"),
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
    "wheels": ({**sinking(-1.0, 0.2), "attitude": leant(2.0), "flying": False, **judged(flyaway=True)}, set(), ""),
}


@pytest.mark.parametrize("what", CAUSES)
def test_causes_of_one_tick(what):
    measured, causes, extent = CAUSES[what]
    robot = Watched(KHEPERA4 if what == "wheels" else CRAZYFLIE).measure(**measured)
    assert robot.step().found == causes
    assert [robot.words(cause) for cause in sorted(causes)][:1] == [extent][: len(causes)]


@pytest.mark.parametrize(("samples", "outcome"), [(1, Outcome.NONE), (2, Outcome.CUT)])
def test_lean_takes_two_samples(samples, outcome):
    robot = Watched().step()
    for _ in range(samples):  # telemetry that stops with the last one
        robot.measure(attitude=leant(1.4), time=robot.t).step()
    assert robot.step(0.3).hazards.outcome() == outcome


@pytest.mark.parametrize(("kind", "touching"), [(KHEPERA4, 0.145), (TURTLEBOT3, 0.2)], ids=["small", "large"])
def test_robots_too_near_hold_nearer_land(kind, touching):
    robot = Watched(kind, "BC", separation=0.3)
    assert robot.step().found == set()
    robot.hear(1, (0.25, 0.0, 0.0))
    assert robot.step().found == {Cause.SEPARATION}
    assert robot.words(Cause.SEPARATION) == "0.25 m from C (limit 0.3 m)"
    robot.hear(1, (touching, 0.0, 0.0))
    assert robot.step().found == {Cause.SEPARATION, Cause.TOUCHING}
    robot.neighbours.mark_lost(1, robot.t)
    assert Cause.SEPARATION in robot.step(1.0).found
    assert Cause.SEPARATION not in robot.step(0.02).found
    robot.neighbours.mark_alive(1)
    assert robot.measure(position=UNKNOWN).step().found == set()


def test_lost_neighbours():
    robot = Watched(KHEPERA4, "BC").step()
    robot.neighbours.mark_lost(0, robot.t)
    assert robot.step(1.0).found == set()
    assert (robot.step(0.03).found, robot.texts) == ({Cause.NEIGHBOUR}, ["warn: a neighbour is lost: B"])
    robot.neighbours.mark_lost(1, robot.t - 2.0)
    robot.status.alone = True
    assert robot.step().found == {Cause.NEIGHBOUR, Cause.ALONE}
    assert robot.words(Cause.ALONE) == "B, C"
    robot.status.cruising = False
    assert robot.step().found == set()
    unheard = Watched(KHEPERA4, "B", separation=2.0)
    unheard.neighbours.discard_pose(0)
    unheard.status.alone = True
    assert unheard.step().found == {Cause.ALONE}
    assert unheard.words(Cause.ALONE) == "none was received"


def test_poses_of_neighbours():
    robot = Watched(KHEPERA4, "BC").step()
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


WANTS_NOTHING = {"ordered": True, "unguided": True, "not_finite": True}


def test_causes_of_orders_and_of_the_process():
    for given, causes, words in (
        ({"ordered": True}, {Cause.ORDERED}, "by an operator"),
        (WANTS_NOTHING, {Cause.ORDERED, Cause.SETPOINT, Cause.CENTRE}, None),
        ({**WANTS_NOTHING, "cruising": False}, {Cause.ORDERED, Cause.CENTRE}, None),
        ({"offline_since": -1.5}, {Cause.ROUTER}, "for 2.5 s"),
        ({"conductor_lost_since": -1.5}, {Cause.CONDUCTOR}, "for 2.5 s"),
        ({"missed_share": 0.95}, {Cause.LATE}, "95% of the last second's"),
        ({"aside": True, "landing": True, "cruising": False}, {Cause.BELOW}, None),
        ({"aside": True, "landing": False, "cruising": False}, set(), None),
    ):
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
    assert robot.step(2.9).acts == []
    assert robot.step(0.2).acts == ["land: no start will come: the conductor is gone for 3.0 s"]


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
    robot, ray = Watched(TURTLEBOT3, avoids=avoids), (0.0,)
    assert robot.step(2.0).found == set()  # there was none yet
    for rays in ((ray,) * 3, ((),) * 3):  # the second time no reading
        assert robot.measure(scan=RangeScan(robot.t, *rays)).step(0.5).found == set()
    robot.measure(scan=None).step(0.02)
    assert robot.texts == (["hold: its range sensors are silent: for 1.0 s"] if avoids else [])


def woken(slept=0.6, neighbours="B"):
    robot = Watched(KHEPERA4, neighbours).step(1.0)
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
    assert held_s(lost, 0.5) == held_s(woken(neighbours=""), 0.5) == 0


def test_silent_neighbours_and_goals_are_awaited_briefly():
    for slept in (0.6, 1.5, 2.2):
        assert held_s(woken(slept), 3.0) == pytest.approx(SILENT_S / DT, abs=1)
    robot = woken()
    robot.health.offline_since = robot.t
    assert held_s(robot, 3.0) == 300  # waiting begins when the router is back
    robot.health.offline_since = math.inf
    assert held_s(robot, 3.0) == pytest.approx(SILENT_S / DT, abs=1)
    robot.health.offline_since = robot.t  # much later: that standstill is over
    assert held_s(robot, 0.5) == 0
    guided = woken(neighbours="")
    for goal_stamp, ticks in ((guided.t - 0.5, 10), (guided.t, 0)):
        guided.status.goal_stamp = goal_stamp
        assert held_s(guided, 0.1) == ticks


def climbs(kind=CRAZYFLIE, **safety):
    robot = Watched(kind, **safety)
    robot.status.cruising, robot.status.climbing = False, True
    return robot


def test_climb_that_is_carried_aside():
    robot = climbs()

    def carry(robot):
        robot.measure(position=(robot.t - 1.0, 0.0, 0.1 + robot.t - 1.0))

    assert robot.step(0.55, carry).texts == []
    assert robot.step(0.05, carry).texts == ["land: it moves without a command: 0.57 m aside while it climbs"]
    robot.status.climbing = False
    assert robot.step().found == set()


@pytest.mark.parametrize(("kind", "patience_s"), [(CRAZYFLIE, 4.0), (TELLO, 10.0)], ids=["crazyflie", "tello"])
def test_climb_without_measured_height(kind, patience_s):
    robot = climbs(kind).measure(position=(0.0, 0.0, 0.02))
    assert robot.step(patience_s).texts == []
    assert robot.step(0.03).texts == ["land: it does not obey commands to move: it does not rise"]


@pytest.mark.parametrize(("spinning", "texts"), [(True, 1), (False, 0)], ids=["motors", "arms"])
def test_climb_by_frozen_captured_height_is_cut(spinning, texts):
    robot = climbs(late_s=0.15).measure(position=(0.0, 0.0, 0.02), spinning=spinning)
    assert robot.step(1.1).texts == []
    assert len(robot.step(0.1).texts) == texts
    assert robot.texts[:1] == ["cut: its measured height does not follow its climb: 0.00 m high after 1.1 s"][:texts]


def lands(**measured):
    robot = Watched(landing_s=2.0).measure(**measured)
    robot.status.cruising, robot.status.landing = False, True
    return robot


def test_landing_that_does_no_good_is_cut():
    for measured, seconds in (
        ({"position": (0.0, 0.0, 0.02)}, 2.0),
        ({"velocity": (0.0, 0.0, 0.5)}, 2.5),
        ({"position": (0.0, 0.0, NAN), "flags": {"invalid": True}}, 2.5 / LOWEST_DESCENT_M_S),  # of its room
    ):
        robot = lands(**measured).step(seconds + 1.9)
        assert robot.acts == []
        assert robot.step(0.2).acts == ["cut: its landing takes too long: more than 2 s without a descent"]


def test_hovering_or_slow_drone_is_never_cut():
    robot = lands().step(30.0)
    assert robot.texts == ["warn: it hovers although commanded to land: at 0.50 m"]
    assert robot.measure(flying=False).step().found == set()

    def sink(robot):
        robot.measure(position=(0.0, 0.0, robot.values["position"][2] - 0.03 * DT))

    assert lands(velocity=(0.0, 0.0, -0.03)).step(15.0, sink).texts == []


NO_ROTATIONS = ((1.0, 0.7, 0.0, 0.0), (10.0, 0.8, 0.0, 0.0), (1e200,) * 4, (0.0,) * 4, (NAN,) * 4)


def test_tilt_is_an_angle_to_the_vertical():
    for attitude, angle in (
        (leant(0.5), 0.5),
        ((math.cos(0.6), 0.0, 0.0, math.sin(0.6)), 0.0),  # turned
        ((0.0, 1.0, 0.0, 0.0), math.pi),
        *((no_rotation, None) for no_rotation in NO_ROTATIONS),
    ):
        assert tilted(attitude, 0.49) == (angle is not None and angle > 0.49)
        assert angle is None or tilt_angle(attitude) == pytest.approx(angle)


START = (0.1, 0.2)


class Standing(Watched):
    """A robot that stands at its start, beside one robot that it receives."""

    def __init__(self, kind=CRAZYFLIE, *, start_within=0.3, start_yaw=NAN, other=(0.35, 0.2), **safety):
        super().__init__(kind, "G", **safety)
        starts = (("F", *START, kind.radius), ("G", *other, kind.radius))
        given = {"name": "F", "kind": kind, "limits": self.limits, "predictor": HOLD, "start": START, "starts": starts}
        self.preflight = Preflight(SimpleNamespace(**given, start_within=start_within, start_yaw=start_yaw))
        self.filter = SetpointFilter(kind, self.limits)
        self.move_other((*other, 0.0))

    def move_other(self, position):
        self.t += DT
        self.hear(0, position)

    def check(self, missing=(), **values):
        """First reason why it must not take off."""
        stands = {"time": self.t, "position": (*START, 0.0), "velocity": ZERO, "yaw": 0.0, "battery": 0.8}
        self.now.state = BodyState(**{**stands, **values})
        self.now.begin(self.t)
        self.filter.judge(self.now)
        reason = self.preflight.check(self.now, missing, self.neighbours, self.health)
        self.passes = self.preflight.passes(self.now, self.neighbours, self.health)
        assert missing or not (reason and self.passes)
        return reason


SWAPPED = "it stands where G begins: addresses or markers are swapped"
FAILURES = {
    "no position": ({"position": UNKNOWN}, "no position of its own"),
    "no heading": ({"yaw": NAN}, "it does not know which way it looks"),
    "old": ({"time": 0.0, "ahead": -0.9}, "no position of its own: positions of F are stamped 0.9 s behind"),
    "outside": ({"position": (2.3, 0.0, 0.0)}, "it is 0.30 m outside the arena"),
    "locked": ({"refusal": "locked: switch it off and on"}, "locked: switch it off and on"),
    "elsewhere": ({"position": (-0.3, 0.2, 0.0)}, "it is 0.40 m from its start (0.1, 0.2), more than 0.3 m"),
    "swapped": ({"position": (0.35, 0.2, 0.0)}, SWAPPED),
    "on a table": ({"position": (0.1, 0.2, 0.7)}, "it does not stand on the floor, but at z = 0.70 m"),
    "carried": ({"velocity": (0.0, 0.4, 0.3)}, "it is not at rest: 0.50 m/s"),
    "upside down": ({"attitude": (0.0, 1.0, 0.0, 0.0)}, "it is not level: it leans 180°"),
    "empty": ({"battery": 0.15}, "its battery is at 15%, less than 20%"),
    "alone": ({"missing": ("G", "centre")}, "never received G, centre"),
    "unknown values": ({"battery": NAN, "velocity": UNKNOWN, "attitude": (NAN,) * 4}, ""),
}


@pytest.mark.parametrize("what", FAILURES)
def test_reason_why_a_drone_is_not_ready(what):
    values, reason = FAILURES[what]
    robot = Standing()
    assert not robot.check()
    assert robot.passes
    assert robot.check(**values) == reason
    assert not robot.check()
    robot.health.offline_since = 0.5
    assert robot.check() == "no connection to a router"


def test_kind_start_and_separation_decide():
    for given, values, reason in (
        ({"kind": KHEPERA4}, {"velocity": (0.5, 0.0, 0.0), "position": (*START, 0.7)}, ""),  # as on a table
        ({"start_within": math.inf, "other": START}, {"position": (1.0, 1.0, 0.0)}, ""),
        ({"start_within": math.inf, "other": (-0.1, 0.2)}, {"position": (-0.1, 0.2, 0.0)}, SWAPPED),
        ({"start_within": math.inf, "other": (0.1, -0.2)}, {"position": (0.1, -0.2, 0.0)}, SWAPPED),
        ({"other": (0.22, 0.2)}, {"position": (0.22, 0.2, 0.0)}, ""),  # two that start in one another are none
        ({"kind": KHEPERA4, "other": (0.3, 0.3), "separation": 0.3}, {}, "it is 0.22 m from G, nearer than 0.3 m"),
        ({"kind": KHEPERA4, "other": (0.3, 0.3), "separation": 0.2}, {}, ""),
        ({"start_yaw": 3.0}, {"yaw": -3.0}, ""),
        ({"start_yaw": 0.0}, {"yaw": 1.05}, f"it is turned by 60° from the yaw of its `start`: turn it, or {FRAME}"),
    ):
        assert Standing(**given).check(**values) == reason


def test_failure_that_lasts_ends_readiness():
    robot = Standing()
    reason = robot.check(battery=0.1)
    times = [(1.0, reason), (1.0 + 0.9 * LOST_S, reason), (1.5, ""), (2.0, reason), (2.0 + LOST_S, reason)]
    assert [robot.preflight.lost(*each) for each in times] == [False, False, False, False, True]
    assert not robot.check()
    assert not robot.passes  # what failed is asked for at length until it is over


@pytest.mark.parametrize(("x", "z", "clear"), [(0.28, 0.6, False), (0.28, 0.05, True), (0.35, 0.6, True)])
def test_drone_does_not_take_off_below_another(x, z, clear):
    robot = Standing()
    robot.move_other((x, 0.2, z))
    reason = robot.check()
    assert reason == ("" if clear else f"G is {z:.2f} m above it")
    assert robot.preflight.lost(robot.t, reason) != clear  # at once: the take-off would pass it
