"""Checks before take-off: a robot that fails one is not ready, and says why."""

import math
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState
from agents.body.limits import Limits
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.situation import ProcessHealth, Situation
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins.predictors import HOLD
from agents.safety.preflight import LOST_S, Preflight
from agents.safety.setpoint_filter import SetpointFilter
from agents.vectors import UNKNOWN, ZERO

START, NAN = (0.1, 0.2), math.nan


class Standing:
    """A robot that stands at its start, beside one robot that it receives."""

    def __init__(self, kind=CRAZYFLIE, *, start_within=0.3, other=(0.35, 0.2), **safety):
        limits = Limits(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.5), **safety)
        starts = (("F", *START, kind.radius), ("G", *other, kind.radius))
        given = {"name": "F", "kind": kind, "limits": limits, "predictor": HOLD, "start": START, "starts": starts}
        self.preflight = Preflight(SimpleNamespace(**given, start_within=start_within))
        self.filter, self.now, self.health = SetpointFilter(kind, limits), Situation(), ProcessHealth()
        self.neighbours, self.t = Neighbours([Incoming(1, "G", kind, 0.25)], limits.neighbour_timeout_s), 1.0
        self.neighbours.mark_alive(0)
        self.hear((*other, 0.0))

    def hear(self, position):
        self.t += 0.01
        self.neighbours.receive(0, position, ZERO, self.t, self.t)

    def check(self, missing=(), **values):
        """First reason why it must not take off."""
        stands = {"time": self.t, "position": (*START, 0.0), "velocity": ZERO, "yaw": 0.0, "battery": 0.8}
        self.now.state = BodyState(**{**stands, **values})
        self.now.begin(self.t)
        self.filter.judge(self.now)
        return self.preflight.check(self.now, missing, self.neighbours, self.health)


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
    ):
        assert Standing(**given).check(**values) == reason


def test_failure_that_lasts_ends_readiness():
    robot = Standing()
    reason = robot.check(battery=0.1)
    times = [(1.0, reason), (1.0 + 0.9 * LOST_S, reason), (1.5, ""), (2.0, reason), (2.0 + LOST_S, reason)]
    assert [robot.preflight.lost(*each) for each in times] == [False, False, False, False, True]


@pytest.mark.parametrize(("x", "z", "clear"), [(0.28, 0.6, False), (0.28, 0.05, True), (0.35, 0.6, True)])
def test_drone_does_not_take_off_below_another(x, z, clear):
    robot = Standing()
    robot.hear((x, 0.2, z))
    reason = robot.check()
    assert reason == ("" if clear else f"G is {z:.2f} m above it")
    assert robot.preflight.lost(robot.t, reason) != clear  # at once: the take-off would pass it
