"""The last word: whatever comes in, what goes out is a setpoint that the robot may have."""

from math import cos, dist, hypot, inf, isfinite, isnan, nan, pi, sin
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.body.interface import BodyState
from agents.body.kinds import KINDS
from agents.body.limits import Limits
from agents.decision.situation import Situation
from agents.safety.setpoint_filter import FLOOR_M, OUTSIDE_M, SetpointFilter, differ
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.cases import examples

EACH = pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
LIMITS = Limits(low=(-1.0, -1.0, 0.0), high=(1.0, 1.0, 2.5), margin=0.05, speed=0.5, max_goal_distance=0.4)
ROOMY = Limits(low=(-1.0, -1.0, 0.0), high=(1.0, 1.0, 2.5), margin=0.05)
SHORT = Limits(low=LIMITS.low, high=LIMITS.high, max_goal_distance=0.1)
odd = st.sampled_from([nan, inf, -inf, 1e308, -1e308, 1e6, 0.0, -0.0])
anything, nearby = st.one_of(st.floats(-3.0, 3.0), st.floats(), odd), st.floats(-1.3, 1.3)
STOP, AHEAD, SLOW = (0.0, 0.0, 0.0, 0.0), (0.3, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0, 0.0)


def filtered(kind, position, *, yaw=0.0, age=0.0, limits=LIMITS):
    """Walls of an arena that is wider by the radius of this kind: what is left of it is there for its centre."""
    (x, y, z), (far_x, far_y, top), r = limits.low, limits.high, kind.radius
    wide = replace(limits, low=(x - r, y - r, z), high=(far_x + r, far_y + r, top))
    made, now = SetpointFilter(kind, wide), Situation()
    now.state = BodyState(-age, position, (0.0, 0.0, 0.0), yaw)
    now.begin(0.0)
    made.judge(now)
    return made, now


def bounds(kind):
    """Where goals may lie: heights of ground robots are nobody's business."""
    (low_x, low_y, low_z), (high_x, high_y, high_z), edge = LIMITS.low, LIMITS.high, LIMITS.margin
    bottom, top = (low_z + max(kind.height, FLOOR_M), high_z - edge) if kind.flies else (-inf, inf)
    return (low_x + edge, low_y + edge, bottom), (high_x - edge, high_y - edge, top)


# setpoint, position, yaw and age
SANE = st.tuples(st.tuples(*[nearby] * 4), st.tuples(*[nearby] * 3), st.floats(-4.0, 4.0), st.floats(0.0, 0.5))
WILD = st.tuples(st.tuples(*[anything] * 4), st.tuples(*[st.one_of(nearby, anything)] * 3), anything, anything)


@EACH
@examples(150)
@given(st.one_of(SANE, WILD))
def test_lawful_setpoint_for_whatever_comes(kind, given):
    setpoint, position, yaw, age = given
    made, now = filtered(kind, position, yaw=yaw, age=age)
    safe = made.limit(setpoint, now)
    believable = all(abs(each) < 1e6 for each in (*position, yaw))
    assert now.invalid == (not (believable and abs(age) <= LIMITS.position_timeout_s))
    if now.invalid:
        assert all(map(isnan, safe)) if kind.takes == "position" else safe == (0.0, 0.0, 0.0, 0.0)
        return
    assert all(map(isfinite, safe))
    assert made.changed == any(abs(a - b) > 1e-9 or isnan(b) for a, b in zip(safe, setpoint, strict=True))
    assert made.changed or not differ(made._within(setpoint, now), setpoint), "a limit that `_lawful` does not know"
    assert made.not_finite == (not all(abs(each) < 1e6 for each in setpoint))
    speed, velocity = min(kind.speed, LIMITS.speed), safe[:3]
    if kind.takes == "position":
        reach, far = min(LIMITS.max_goal_distance, speed / kind.response), max(map(abs, position))
        assert dist(safe[:3], position) <= reach * (1 + 1e-9) + 1e-9 * far
        velocity = [goal - here for goal, here in zip(safe, position, strict=False)]
    else:
        turn = 1 if kind.takes == "twist" else 3
        assert max(map(abs, safe[:turn])) <= speed
        assert kind.flies or hypot(*safe[: min(turn, 2)]) <= speed * (1.0 + 1e-12), "in any direction"
        assert abs(safe[turn]) <= kind.turn_rate
        velocity = (safe[0] * cos(yaw), safe[0] * sin(yaw), 0.0) if turn == 1 else velocity
    for goal, v, here, low, high in zip(safe, velocity, position, *bounds(kind), strict=False):
        assert not (v > 0.0 and here > high), "not farther out"
        assert not (v < 0.0 and here < low)
        assert kind.takes != "position" or not low <= here <= high or low - 1e-12 <= goal <= high + 1e-12


K, T, V = KHEPERA4.response, TURTLEBOT3.response, TELLO.response  # [1/s]


@pytest.mark.parametrize(
    ("kind", "position", "given", "setpoint", "safe"),
    [
        (CRAZYFLIE, (0.0, 0.0, 0.8), {}, (0.1, 0.2, 0.8, 0.3), None),
        (CRAZYFLIE, (0.0, 0.0, 2.3), {"limits": LIMITS}, (0.0, 0.0, 9.0, 0.5), (0.0, 0.0, 2.39, 0.5)),
        (CRAZYFLIE, (0.3, 0.2, 0.8), {}, (nan, 0.0, 0.0, 0.0), (0.3, 0.2, 0.8, 0.0)),  # it stays
        # 0.5 m/s, closed at 2/s: a goal may be 0.25 m ahead
        (CRAZYFLIE, (0.0, 0.0, 1.0), {"limits": LIMITS}, (0.9, 0.0, 1.0, 0.0), (0.25, 0.0, 1.0, 0.0)),
        (CRAZYFLIE, (0.0, 0.0, 1.0), {"limits": SHORT}, (0.9, 0.0, 1.0, 0.0), (0.1, 0.0, 1.0, 0.0)),
        (TELLO, (0.6, 0.6, 0.8), {}, (0.2, 0.1, -0.1, 1.0), None),
        (TELLO, (0.0, 0.0, 1.0), {"limits": LIMITS}, (9.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0)),
        (TELLO, (-0.5, 0.0, 1.0), {}, (1.0, 0.5, 0.0, 0.0), None),
        (TELLO, (0.65, 0.0, 1.0), {}, (1.0, 0.5, 0.0, 0.0), (0.3 * V, 0.5, 0.0, 0.0)),
        (TELLO, (0.65, 0.0, 1.0), {"age": 0.2}, (1.0, 0.5, 0.0, 0.0), (0.3 / (1 / V + 0.2), 0.5, 0.0, 0.0)),
        (TELLO, (0.95, 0.0, 1.0), {}, (1.0, 0.5, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0)),
        (TELLO, (1.0, 0.0, 1.0), {}, (1.0, 0.5, 0.0, 0.0), (-0.05 * V, 0.5, 0.0, 0.0)),  # back
        (KHEPERA4, (0.6, 0.6, 0.0), {}, (0.2, 2.0, 0.0, 0.0), None),
        (KHEPERA4, (0.0, 0.0, 0.0), {}, (9.0, 0.0, 0.0, 0.0), (KHEPERA4.speed, 0.0, 0.0, 0.0)),
        (KHEPERA4, (0.97, 0.0, 0.0), {}, (0.2, 1.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)),
        (KHEPERA4, (0.97, 0.0, 0.0), {}, (-0.2, 1.0, 0.0, 0.0), None),
        (KHEPERA4, (0.85, 0.0, 0.0), {}, (0.2, 1.0, 0.0, 0.0), (0.1 * K, 1.0, 0.0, 0.0)),
        (TURTLEBOT3, (0.85, 0.0, 0.0), {}, (0.2, 1.0, 0.0, 0.0), (0.1 * T, 1.0, 0.0, 0.0)),
        (TURTLEBOT3, (0.85, 0.0, 0.0), {"yaw": pi}, (-0.2, 1.0, 0.0, 0.0), (-0.1 * T, 1.0, 0.0, 0.0)),
        (TURTLEBOT3, (0.85, 0.0, 0.0), {"yaw": pi}, (0.2, 1.0, 0.0, 0.0), None),
        (TURTLEBOT3, (0.85, 0.0, 0.0), {"yaw": 1.2}, (0.2, 1.0, 0.0, 0.0), None),  # along the wall
    ],
)
def test_setpoint_is_changed_where_it_must(kind, position, given, setpoint, safe):
    made, now = filtered(kind, position, **{"limits": ROOMY, **given})
    found = made.limit(setpoint, now)
    assert found == pytest.approx(safe, abs=1e-12) if safe else found == setpoint
    assert (made.changed, made.not_finite, made.avoided) == (safe is not None, isnan(setpoint[0]), False)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_far_outside_is_outside_for_sure(axis, side):
    for beyond, escaped in ((OUTSIDE_M - 0.01, False), (OUTSIDE_M + 0.01, True)):
        place = [0.0, 0.0, 1.25]
        place[axis] = (LIMITS.high[axis] if side > 0 else LIMITS.low[axis]) + side * beyond
        place[axis] += side * CRAZYFLIE.radius if axis < 2 else 0.0
        _, now = filtered(CRAZYFLIE, tuple(place))
        assert (now.outside, now.invalid, now.sound, now.flyaway) == (escaped, False, False, False)
        assert now.excess == pytest.approx(beyond)
        assert now.outside_wall == (axis < 2 or side > 0)  # floors are measured a little below themselves


def test_sound_pose_clears_what_was_judged_before():
    made, now = filtered(CRAZYFLIE, (3.0 + CRAZYFLIE.radius, 0.0, 1.0))
    assert (now.outside_wall, now.outside, now.flyaway, now.excess) == (True, True, True, pytest.approx(2.0))
    for position, sound in (((nan, 0.0, 1.0), False), ((0.0, 0.0, 1.0), True)):
        now.position = position
        made.judge(now)
        assert (now.sound, now.invalid) == (sound, not sound)
        assert (now.outside_wall, now.outside, now.flyaway, now.excess) == (False, False, False, 0.0)


def test_avoidance_is_held_to_the_limits():
    for age, setpoint, avoids, safe, avoided in (
        (0.0, AHEAD, SLOW, SLOW, True),
        (0.0, AHEAD, (0.0, 9.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0), True),
        (0.0, AHEAD, AHEAD, AHEAD, False),
        (0.0, AHEAD, (nan, 0.0, 0.0, 0.0), AHEAD, False),
        (0.5, AHEAD, SLOW, SLOW, True),
        *((age, AHEAD, SLOW, STOP, False) for age in (0.51, inf, nan)),  # without a pose
        (0.0, (nan, 0.0, 0.0, 0.0), SLOW, STOP, False),
    ):
        made, now = filtered(TELLO, (0.0, 0.0, 1.0), age=age)
        assert made.check(setpoint, now, SimpleNamespace(restrain=lambda *_, avoids=avoids: avoids), None, None) == safe
        assert (made.avoided, made.not_finite) == (avoided, isnan(setpoint[0]))
        assert made.changed == (avoided or made.not_finite)
