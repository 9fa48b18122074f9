"""A twin beside a robot: it is told the same, put onto it when it should be, and never in its way."""

from dataclasses import replace

import numpy as np
import pytest

from agents.body.interface import BodyRequest, BodyState, Disturbance
from agents.body.kinds import KINDS
from agents.body.shadow_twin import Shadowed, shadowed
from agents.network.keys import Keys

DT = 0.1


class Driven:
    """Rows that move as they are told, at a share of the speed and off by a constant; writes down what it is told."""

    def __init__(self, rows, *, share=1.0, off=0.0):
        self.position, self.yaw = np.zeros((rows, 3)), np.zeros(rows)
        self.velocity = np.zeros((rows, 3))
        self.share, self.off = share, off
        self.told, self.placed = [], []
        self.t = 0.0
        self.stale = 0.0
        self.flying = np.zeros(rows, dtype=bool)
        self.broken, self.failure = "", RuntimeError

    def _may(self, what):
        if self.broken == what:
            raise self.failure("no engine")

    def open(self):
        self._may("open")
        self.told.append("open")

    def read(self, t):
        self._may("read")
        self.position = self.position + (t - self.t) * self.share * self.velocity
        self.t = t
        rows = len(self.yaw)
        nothing = np.full((rows, 3), np.nan)
        return BodyState(
            time=np.full(rows, t - self.stale),
            position=self.position + self.off,
            velocity=self.velocity.copy(),
            yaw=self.yaw.copy(),
            true_position=nothing,
            true_yaw=nothing[:, 0],
            battery=nothing[:, 0],
            flying=self.flying.copy(),
        )

    def command(self, setpoint):
        self._may("command")
        self.told.append(("command", setpoint[:, 0].tolist()))
        given = np.isfinite(setpoint[:, 0])
        self.velocity[given, 0] = setpoint[given, 0]

    def takeoff(self, rows, height):
        self._may("takeoff")
        self.told.append(("takeoff", rows.tolist(), height.tolist()))
        self.flying[rows] = True

    def land(self, rows):
        self._may("land")
        self.told.append(("land", rows.tolist()))

    def stop(self, rows):
        self._may("stop")
        self.told.append(("stop", rows.tolist()))

    def locate(self, row, t, position, yaw):
        self.told.append(("locate", row))

    def close(self):
        self._may("close")
        self.told.append("close")

    def place(self, rows, position, yaw, flying, velocity=None):
        self._may("place")
        self.placed.append((round(self.t, 6), rows.tolist(), position[:, 0].tolist(), flying.tolist(), velocity))
        self.position[rows], self.yaw[rows] = position, yaw


def beside(rows=1, shadows=(0,), restart=np.inf, *, share=1.0, off=0.0):
    """A robot and its twin, which is faster by `share` and measured `off` [m]."""
    robot, twin = Driven(rows, off=off), Driven(len(shadows), share=share)
    return Shadowed(robot, twin, np.array(shadows), np.full(len(shadows), restart)), robot, twin


def speeds(*values):
    """Setpoints that say how fast to go along x."""
    setpoint = np.zeros((len(values), 4))
    setpoint[:, 0] = values
    return setpoint


def differences(body, duration, speed=0.5):
    """What the twin is ahead, at each tick."""
    ahead = []
    for k in range(round(duration / DT) + 1):
        state = body.read(k * DT)
        ahead.append(state.shadow_position[0, 0] - state.position[0, 0])
        body.command(speeds(*[speed] * len(state.yaw)))
    return np.array(ahead)


def test_a_twin_that_is_faster_runs_ahead_until_it_is_put_back():
    body, _, twin = beside(restart=1.0, share=1.1)
    ahead = differences(body, 3.05)
    # driven at 0, seen to be driven at 0.1, and put back 1 s and 2 s after that
    since = np.maximum(np.arange(31) - 1, 0) % 10 * DT
    np.testing.assert_allclose(ahead, 0.05 * since, atol=1e-12)
    assert [at for at, *_ in twin.placed] == [0.0, 0.1, 1.1, 2.1]


def test_once_is_when_it_is_first_driven():
    body, _, twin = beside(share=1.1)
    ahead = differences(body, 3.05)
    np.testing.assert_allclose(ahead, 0.05 * np.maximum(np.arange(31) - 1, 0) * DT, atol=1e-12)
    assert [at for at, *_ in twin.placed] == [0.0, 0.1]


def test_it_is_put_where_the_robot_is_measured_to_be_and_moves_as_it_does():
    body, robot, twin = beside(off=0.25)
    body.read(0.0)
    assert twin.placed[0][2] == [0.25]
    robot.velocity[0, 0] = 0.3
    body.command(speeds(0.4))
    state = body.read(0.1)
    np.testing.assert_allclose(twin.placed[1][4], [[0.4, 0.0, 0.0]])
    np.testing.assert_allclose(state.shadow_position, state.position)


def test_only_rows_with_a_shadow_have_one_and_hear_orders_as_rows_of_their_own():
    body, robot, twin = beside(rows=3, shadows=(0, 2))
    body.open()
    state = body.read(0.0)
    assert np.isnan(state.shadow_position[1]).all()
    assert np.isnan(state.shadow_yaw).tolist() == [False, True, False]
    body.takeoff(np.array([1, 2]), np.array([0.5, 0.7]))
    body.command(speeds(0.1, 0.2, 0.3))
    body.land(np.array([1]))
    body.land(np.array([2, 0]))
    body.stop(np.array([0, 1, 2]))
    body.locate(2, 0.0, np.zeros(3), 0.0)
    body.close()
    assert robot.told == [
        "open", ("takeoff", [1, 2], [0.5, 0.7]), ("command", [0.1, 0.2, 0.3]), ("land", [1]), ("land", [2, 0]),
        ("stop", [0, 1, 2]), ("locate", 2), "close",
    ]  # fmt: skip
    assert twin.told == [
        "open", ("takeoff", [1], [0.7]), ("command", [0.1, 0.3]), ("land", []), ("land", [1, 0]), ("stop", [0, 1]),
        "close",
    ]  # fmt: skip


def test_standing_still_is_not_being_driven_and_a_landing_is_left_alone():
    body, robot, twin = beside(restart=0.5)
    robot.flying[:] = True
    for k in range(10):
        body.read(k * DT)
        body.command(np.full((1, 4), np.nan) if k % 2 else np.zeros((1, 4)))
    assert [at for at, *_ in twin.placed] == [0.0]
    body.command(speeds(0.2))
    body.read(1.0)
    body.land(np.array([0]))
    for k in range(11, 30):
        body.read(k * DT)
    assert [(at, flying) for at, _, _, flying, _ in twin.placed] == [(0.0, [True]), (1.0, [True])]


def test_it_waits_for_a_pose_that_is_fresh():
    body, robot, twin = beside()
    robot.stale = 1.0
    assert np.isnan(body.read(0.0).shadow_position).all()
    robot.stale, robot.position[0, 0] = 0.0, np.nan
    assert np.isnan(body.read(0.1).shadow_position).all()
    robot.position[0, 0] = 2.0
    assert body.read(0.2).shadow_position[0, 0] == 2.0
    assert len(twin.placed) == 1


@pytest.mark.parametrize("what", ["open", "read", "place", "command", "takeoff", "land", "stop", "close"])
def test_a_twin_that_fails_is_left_alone_and_the_robot_goes_on(what):
    body, robot, twin = beside()
    twin.broken = what
    body.open()
    plain = [robot.read(k * DT) for k in range(3)]
    robot.t, robot.position[:] = 0.0, 0.0
    for k in range(3):
        state = body.read(k * DT)
        np.testing.assert_array_equal(state.position, plain[k].position)
        if k == 0:
            body.takeoff(np.array([0]), np.array([1.0]))
            body.land(np.array([0]))
            body.stop(np.array([0]))
            body.command(np.zeros((1, 4)))
    body.close()
    assert robot.told == ["open", ("takeoff", [0], [1.0]), ("land", [0]), ("stop", [0]), ("command", [0.0]), "close"]
    if what != "close":
        assert state.notes == ("its shadow failed: RuntimeError: no engine",)
        assert np.isnan(state.shadow_position).all()


@pytest.mark.parametrize("failure", [AssertionError, MemoryError, StopIteration, SystemError, Exception])
def test_shadow_failures_of_any_kind_stay_without_effect(failure):
    body, _, twin = beside()
    twin.broken, twin.failure = "command", failure
    body.read(0.0)
    body.command(np.ones((1, 4)))
    assert body.read(DT).notes == (f"its shadow failed: {failure.__name__}: no engine",)


def test_what_the_robot_itself_says_is_kept():
    body, robot, _ = beside(rows=2, shadows=(1,))
    plain = robot.read
    robot.read = lambda t: replace(plain(t), notes=("locked", "tumbled"))
    assert body.read(0.0).notes == ("locked", "tumbled")


def test_a_failure_of_the_robot_is_not_hidden():
    body, robot, _ = beside()
    robot.broken = "read"
    with pytest.raises(RuntimeError, match="no engine"):
        body.read(0.0)


def request(*kinds):
    rows = len(kinds)
    return BodyRequest(
        names=tuple(f"R{k}" for k in range(rows)),
        kinds=tuple(KINDS[kind] for kind in kinds),
        addresses=("radio://0/80/2M/E7E7E7E701",) * rows,
        start=np.zeros((rows, 3)),
        yaw=np.zeros(rows),
        rate_hz=100.0,
        seeds=(7,) * rows,
        disturbance=(Disturbance(position_sigma=0.1, latency_s=0.1, odometry_drift=0.1),) * rows,
        external=(True,) * rows,
        device=({"tx_power": 3},) * rows,
        endpoints=(),
        keys=Keys(),
    )


def test_nobody_with_a_shadow_means_the_body_itself():
    robot = Driven(2)
    assert shadowed(robot, request("khepera4", "tello"), np.full(2, np.nan)) is robot


@pytest.mark.parametrize(("kind", "setpoint"), [("khepera4", [0.2, 0.0, 0.0, 0.0]), ("tello", [0.2, 0.0, 0.0, 0.0])])
def test_the_twin_is_free_of_all_that_nature_adds(kind, setpoint):
    robot = Driven(2)
    robot.flying[:] = kind == "tello"
    body = shadowed(robot, request("crazyflie", kind), np.array([np.nan, 1.0]))
    for k in range(101):
        state = body.read(k / 100)
        body.command(np.array([[np.nan] * 4, setpoint]))
    assert np.isnan(state.shadow_position[0]).all()
    assert state.position[1, 0] == pytest.approx(0.2)
    assert state.shadow_position[1, 0] == pytest.approx(0.2)  # it took over the robot's speed with its place
    assert state.shadow_position[1, 1:].tolist() == [0.0, 0.0]
