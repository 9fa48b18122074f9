"""The kinds that come along: each reaches goals and keeps a formation, and nothing takes it for disobedient."""

from dataclasses import replace
from math import hypot, inf, nan

import pytest

from agents.body.interface import BodyState
from agents.body.kinds import KINDS
from agents.body.limits import Limits
from agents.decision.position_control import PositionController
from agents.decision.situation import Situation
from agents.kinds.ackermann import ACKERMANN, NEAR
from agents.kinds.omni import OMNI
from agents.kinds.theory import DOUBLE_INTEGRATOR, POINT, UNICYCLE
from agents.plugins.registry import PluginError
from agents.safety.setpoint_filter import SetpointFilter
from experiments.check.analysis import Analysis
from experiments.check.ideal_run import predict
from experiments.check.motion import turning_circle
from experiments.file.document import loads
from experiments.file.problems import DocumentError
from twins.engines.point_mass import has_model, model

NEW = (OMNI, ACKERMANN, POINT, DOUBLE_INTEGRATOR, UNICYCLE)
DT = 0.02
GOALS = [(1.0, 0.0), (0.0, 0.15), (0.0, 0.5), (-1.0, 0.0), (0.0, 1.0), (-0.3, 0.3), (0.1, 0.05), (-0.5, -0.1)]
new = pytest.mark.parametrize("kind", NEW, ids=lambda kind: kind.name)


@new
@pytest.mark.parametrize("goal", GOALS)
def test_every_goal_is_reached(kind, goal):
    motion, controller, way = model(kind, (0.0, 0.0, 0.0), 0.0), PositionController(kind), 0.0
    for _ in range(500):
        motion.command(controller.setpoint((*goal, 0.0), nan, motion.position, motion.yaw))
        motion.move(DT)
        way += DT * hypot(*motion.velocity[:2])
        assert hypot(*motion.velocity[:2]) <= 1.5 * kind.speed
    assert hypot(motion.position[0] - goal[0], motion.position[1] - goal[1]) < 1.1 * NEAR
    assert way < hypot(*goal) + 0.8


@new
def test_a_robot_without_commands_stops(kind):
    motion = model(kind, (0.0, 0.0, 0.0), 0.3)
    motion.command((0.2, 0.1, 0.0, 0.0))
    for stops in (motion.land, motion.stop):
        motion.command((0.2, 0.1, 0.0, 0.0))
        for _ in range(50):
            motion.move(DT)
        motion.command((nan,) * 4)
        assert hypot(*motion.velocity) > 0.15
        stops()
        for _ in range(150):
            motion.move(DT)
        assert hypot(*motion.velocity) < 1e-3


FOLLOW = """
title = "Two follow a leader along a circle"
duration_s = 30.0
arena.size = [8.0, 8.0, 2.5]
robots.A = { kind = "KIND", start = [0.0, 0.0] }
robots.B = { kind = "KIND", start = [-1.0, -0.6] }
robots.C = { kind = "KIND", start = [-1.0, 0.7, 1.0] }
[formation]
law = "displacement"
leader = "A"
links = { "A > B" = { offset = [-0.8, 0.0] }, "A > C" = { offset = [-0.8, 0.8] } }
[[timeline]]
at_s = 1.0
robot = "A"
plan = { kind = "circle", radius = 1.0, period_s = 120.0 }
"""


def following(kind, extra=""):
    return loads(extra + FOLLOW.replace("KIND", kind))


def test_check_says_what_cannot_turn_on_the_spot():
    for kind, codes in (("ackermann", ["turning-circle"]), ("omni", [])):
        (case,) = following(kind).cases().values()
        assert [each.code for each in turning_circle(Analysis(case, predict(case)))] == codes


@pytest.mark.parametrize("kind", ["omni", "ackermann", "point", "double-integrator"])
def test_pymunk_refuses_other_motions_in_the_file(kind):
    with pytest.raises(DocumentError) as caught:
        following(kind, 'world = { engine = "pymunk" }')
    assert f"'{kind}' does not move in this engine" in caught.value.problems[0].message
    assert following(kind, 'world = { engine = "mujoco" }')


def test_a_twist_keeps_to_the_turning_circle():
    made = SetpointFilter(ACKERMANN, Limits(low=(-5.0, -5.0, 0.0), high=(5.0, 5.0, 2.0), margin=0.05))
    now = Situation()
    now.state = BodyState(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
    now.begin(0.0)
    made.judge(now)
    for v, omega, allowed in ((0.1, 1.0, 0.1 / ACKERMANN.turn_radius), (0.0, 1.0, 0.0), (-0.3, -0.5, -0.5)):
        assert made.limit((v, omega, 0.0, 0.0), now) == pytest.approx((v, allowed, 0.0, 0.0))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"radius": nan}, "radius"), ({"speed": inf}, "speed"), ({"response": 0.0}, "response"), ({"lag": -1.0}, "lag"),
        ({"flies": True}, "flies"), ({"takes": "position"}, "drives"),
    ],
)  # fmt: skip
def test_numbers_that_no_robot_has_are_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        replace(UNICYCLE, **changed)


def test_motion_fits_the_setpoint():
    assert all(has_model(kind) for kind in KINDS.values())
    assert not has_model(replace(OMNI, motion=ACKERMANN.motion))
    assert not has_model(replace(OMNI, motion=None))
    with pytest.raises(PluginError, match="motion of the kind 'omni'"):
        model(replace(OMNI, motion="nowhere:Motion"), (0.0, 0.0, 0.0), 0.0)
