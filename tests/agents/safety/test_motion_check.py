"""Robots of every kind that are commanded to move and do not, and robots that move without a command."""

import math

import pytest

from agents.body.kinds import KINDS
from agents.safety.motion_check import MotionCheck
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3

DT, FINE = 0.01, (False, False)
every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
wheels = pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3], ids=lambda kind: kind.name)


class Told:
    """A robot: its setpoints, and where it is measured."""

    def __init__(self, kind):
        self.kind, self.motion_check = kind, MotionCheck(kind)
        self.position, self.yaw, self.tick = (0.0, 0.0, 0.0), 0.0, 0

    def go(self, seconds, *, told=0.0, told_turn=0.0, speed=0.0, turn=0.0, every=1, step=1e-9):
        """Let time pass; it moves along its nose, and is measured every so many ticks, in whole steps [m]."""
        (x, y, z), heading = self.position, self.yaw
        for _ in range(round(seconds / DT)):
            x, y = x + DT * speed * math.cos(heading), y + DT * speed * math.sin(heading)
            heading += turn * DT
            if self.tick % every == 0:
                self.position, self.yaw = (round(x / step) * step, round(y / step) * step, z), heading
            setpoint = (told, told_turn if self.kind.takes == "twist" else 0.0, 0.0, 0.0)
            if self.kind.takes == "position":
                setpoint = (self.position[0] + told / self.kind.response, *self.position[1:], 0.0)
            self.motion_check.update(self.tick * DT, setpoint, self.position, self.yaw, True)
            self.tick += 1
        return self.motion_check.unresponsive, self.motion_check.uncommanded


@every_kind
def test_obedient_robot(kind):
    for speed in (0.1 * kind.speed, 0.5 * kind.speed, kind.speed):
        robot = Told(kind)
        assert robot.go(1.0) == FINE
        for _ in range(10):
            assert robot.go(1.0, told=speed, speed=speed) == FINE
        assert robot.go(0.4, speed=speed) == FINE  # it takes some time to stop
        assert robot.go(5.0) == FINE
    assert robot.go(60.0, told=0.05 * kind.speed) == FINE  # near its goal it need not move


@every_kind
def test_robot_that_does_not_move(kind):
    robot = Told(kind)
    assert robot.go(1.5, told=kind.speed) == FINE
    assert robot.go(2.0, told=kind.speed) == (True, False)
    assert robot.motion_check.commanded == pytest.approx(3.4 * kind.speed, rel=0.05)
    assert robot.go(1.5, told=kind.speed, speed=0.9 * kind.speed) == FINE  # it has begun
    assert robot.go(3.4, told=kind.speed) == (True, False)
    robot.tick += 20  # missed ticks: the count restarts
    assert (robot.go(DT, told=kind.speed), robot.motion_check.commanded) == (FINE, 0.0)


@wheels
def test_wheels_that_ignore_or_need_no_commands(kind):
    for seconds, given, found in (
        (8.0, {"told": 0.05}, (True, False)),  # it crawls
        (4.0, {"told_turn": 1.5}, (True, False)),
        (4.0, {"told_turn": 1.5, "turn": 1.5}, FINE),
        (5.0, {"speed": 0.1}, (False, True)),  # as a Khepera that has lost its link
        (4.0, {"turn": 1.0}, (False, True)),
        (4.0, {"turn": 1.0, "told_turn": 1.0}, FINE),
    ):
        assert Told(kind).go(seconds, **given) == found
    turning, coarse = Told(kind), Told(kind)  # small turns and coarse positions are no disobedience
    for turn in (1.5, -1.5) * 40:
        assert turning.go(0.1, told_turn=turn) == FINE
    for _ in range(20):
        assert coarse.go(1.0, told=0.05, speed=0.05, every=4, step=0.01) == FINE


@every_kind
def test_robot_that_moves_without_being_told(kind):
    robot = Told(kind)
    assert robot.go(2.0) == FINE
    assert robot.go(4.0, speed=0.4 * kind.speed) == (False, True)
    assert robot.motion_check.drifted > 0.5 * kind.speed
    assert robot.go(15.0) == FINE
    assert Told(kind).go(3.0, told=0.5 * kind.speed, speed=-0.5 * kind.speed) == (False, True)
    robot.position = (30.0, 30.0, 30.0)  # it was carried
    assert robot.go(3.0) == FINE


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO], ids=lambda kind: kind.name)
def test_wind_that_dies_is_forgotten(kind):
    robot = Told(kind)
    assert robot.go(10.0, told=0.2 * kind.speed) == FINE
    assert robot.go(20.0, told=0.15 * kind.speed, speed=0.16 * kind.speed) == FINE


def sways(robot, seconds, *, sign, ways=0.0, turns=0.0):
    """A robot that goes to and fro slowly, its motion that of its commands times a sign; returns when it is found."""
    for second in range(seconds):
        way = (-1) ** (second // 2)
        given = {"told": way * ways, "speed": sign * way * ways, "told_turn": way * turns, "turn": sign * way * turns}
        if True in robot.go(1.0, **given):
            return second
    return None


@wheels
def test_slow_motion_against_commands_is_found(kind):
    for given, most in (({"turns": 0.3}, 8), ({"ways": 0.1}, 14)):
        assert sways(Told(kind), 60, sign=1.0, **given) is None
        found = Told(kind)
        assert sways(found, 60, sign=-1.0, **given) <= most
        assert found.motion_check.words().partition("its commands; ")[2]
    for given in ({"turns": 0.05}, {"ways": 0.01}):  # motion as small as noise
        assert sways(Told(kind), 60, sign=-1.0, **given) is None


@every_kind
@pytest.mark.parametrize("shape", [lambda sine: sine, lambda sine: math.copysign(1.0, sine)], ids=["sine", "square"])
def test_late_motion_is_not_against_commands(kind, shape):
    """Commands to and fro in a second or more; a right robot that had motion of half a period late was landed."""
    for period_s in (1.0, 1.2, 1.5, 2.0, 4.0):
        for late in (15, 30, 45, 60):
            robot, given = Told(kind), [0.0] * late
            for tick in range(1500):
                given.append(shape(math.sin(2.0 * math.pi * DT * tick / period_s)))
                now, then = given[-1], given[-1 - late]
                way, turn = 0.4 * kind.speed, 0.8
                robot.go(DT, told=way * now, speed=way * then, told_turn=turn * now, turn=turn * then)
                assert not robot.motion_check.way_against, (period_s, late)
                assert not robot.motion_check.turns_against, (period_s, late)


@every_kind
@pytest.mark.parametrize(
    ("setpoint", "speed", "watched"),
    [((math.nan,) * 4, 0.0, True), ((math.inf, 0.0, 0.0, 0.0), 0.0, True), ((0.0,) * 4, 0.3, False)],
    ids=["none", "infinite", "unwatched"],
)
def test_robot_without_commands_or_unwatched_obeys(kind, setpoint, speed, watched):
    motion_check = MotionCheck(kind)
    for tick in range(1000):
        yaw = math.inf if watched and tick % 2 else 0.0
        motion_check.update(tick * DT, setpoint, (speed * DT * tick, 0.0, 0.0), yaw, watched)
        assert (motion_check.unresponsive, motion_check.uncommanded) == FINE
    assert (motion_check.commanded, motion_check.drifted) == (0.0, 0.0)


@pytest.mark.parametrize(("position", "yaw"), [((1.0, 0.0, 0.5), math.nan), ((1.0, math.nan, 0.5), 0.0)])
def test_partly_known_pose_is_no_begin(position, yaw):
    robot = Told(CRAZYFLIE)
    robot.position = (1.0, 0.0, 0.5)
    robot.go(1.0, told=0.5, speed=0.5)
    for _ in range(100):
        robot.motion_check.update(robot.tick * DT, (2.0, 0.0, 0.5, 0.0), position, yaw, False)
        robot.tick += 1
    assert robot.go(10.0, told=0.5, speed=0.5) == FINE
    assert robot.motion_check.drifted < 0.1
    assert robot.go(4.0, speed=0.5) == (False, True)
