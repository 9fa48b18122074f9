"""Position controllers: they arrive, within the limits, as the wheels allow; rows decide as if alone."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.arrays import every, some, span
from agents.body.kinds import CRAZYFLIE, KHEPERA4, KINDS, TELLO, TURTLEBOT3
from agents.decision.position_control import REACHED, TURNED, PositionController, drive, wrap
from twins.models.differential import Differential

FEW = settings(max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)
GROUND = (KHEPERA4, TURTLEBOT3)
NOWHERE = np.full((1, 3), np.nan)


def run(kinds, start, yaw, *, goal, toward, seconds, dt=0.01):
    """Drives twins to their goals: positions (T, n, 3), yaws (T, n), setpoints (T, n, 4)."""
    twin, control = Differential(kinds, start, yaw, dt), PositionController(kinds)
    positions, yaws, setpoints = [], [], []
    for _ in range(round(seconds / dt)):
        setpoint = control.setpoint(goal, toward, twin.position, twin.yaw)
        twin.command(setpoint[:, :2])
        twin.advance()
        positions.append(twin.position.copy())
        yaws.append(twin.yaw.copy())
        setpoints.append(setpoint)
    return np.array(positions), np.array(yaws), np.array(setpoints)


@pytest.fixture(scope="module")
def drives():
    """Twenty random ways of each ground robot; half of them are told where to look in the end."""
    rng = np.random.default_rng(11)
    kinds = GROUND * 20
    start, goal = np.zeros((40, 3)), np.zeros((40, 3))
    start[:, :2], goal[:, :2] = rng.uniform(-0.6, 0.6, (2, 40, 2))
    yaw, toward = rng.uniform(-math.pi, math.pi, (2, 40))
    toward[20:] = np.nan
    return kinds, start, yaw, goal, toward, *run(kinds, start, yaw, goal=goal, toward=toward, seconds=16.0)


def test_ground_robots_arrive_and_stand(drives):
    kinds, _, _, goal, _, positions, _, setpoints = drives
    assert np.linalg.norm(positions[-1] - goal, axis=1).max() <= REACHED
    assert not setpoints[-50:].any()
    assert len(kinds) == 40


def test_they_turn_to_the_yaw_wanted(drives):
    *_, toward, _, yaws, _ = drives
    assert np.abs(wrap(toward[:20] - yaws[-1, :20])).max() <= TURNED + 1e-3


def test_they_never_slip_sideways(drives):
    _, start, yaw, _, _, positions, yaws, _ = drives
    step = np.diff(np.concatenate([start[None], positions]), axis=0)
    before = np.concatenate([yaw[None], yaws[:-1]])
    middle = 0.5 * (before + yaws)
    sideways = step[..., 1] * np.cos(middle) - step[..., 0] * np.sin(middle)  # paper, eq. (1)
    assert np.abs(sideways).max() < 1e-15


def test_setpoints_are_within_the_limits(drives):
    kinds, *_, setpoints = drives
    assert (np.abs(setpoints[..., 0]) <= [kind.speed for kind in kinds]).all()
    assert (np.abs(setpoints[..., 1]) <= [kind.turn_rate for kind in kinds]).all()
    assert not setpoints[..., 2:].any()
    assert np.abs(setpoints[..., 0]).max() > 0.2


def test_they_drive_backward_to_what_lies_behind():
    limits = {
        "response": np.ones(2), "turn_response": np.ones(2), "speed": np.full(2, 0.3), "turn_rate": np.ones(2)
    }  # fmt: skip
    way = np.array([[0.2, 0.0], [-0.2, 0.0]])
    twist = drive(way, np.zeros(2), np.full(2, np.nan), **limits)
    np.testing.assert_allclose(twist, [[0.2, 0.0], [-0.2, 0.0]], atol=1e-15)


@pytest.mark.parametrize("late", [0, 2], ids=["at once", "two ticks late"])
def test_they_choose_one_end_and_arrive_wherever_the_goal_lies(late):
    """Abeam to the last bit too, without any noise: the end that drives ahead is chosen once."""
    bearings = np.radians([*range(-180, 180, 30), 88.0, 89.0, 89.9, 90.1, 91.0, 92.0])
    ways = [(kind, yaw, bearing, distance) for kind in GROUND for yaw in (0.0, 0.3, -2.0) for bearing in bearings
            for distance in (0.02, 0.3, 1.0)]  # fmt: skip
    kinds, (yaw, bearing, distance) = tuple(way[0] for way in ways), np.array([way[1:] for way in ways]).T
    goal = distance[:, None] * np.stack([np.cos(yaw + bearing), np.sin(yaw + bearing), np.zeros(len(ways))], axis=1)
    goal[(yaw == 0.0) & (np.abs(goal[:, 0]) < 1e-12), 0] = 0.0
    twin, control = Differential(kinds, np.zeros_like(goal), yaw, 0.02), PositionController(kinds)
    last, changes = np.zeros(len(ways)), np.zeros(len(ways))
    seen = [(twin.position.copy(), twin.yaw.copy())] * late
    for _ in range(800):
        seen.append((twin.position.copy(), twin.yaw.copy()))
        setpoint = control.setpoint(goal, np.full(len(ways), np.nan), *seen[-1 - late])
        changes += setpoint[:, 0] * last < 0.0
        last = np.where(setpoint[:, 0] == 0.0, last, setpoint[:, 0])
        twin.command(setpoint[:, :2])
        twin.advance()
    assert np.linalg.norm(twin.position - goal, axis=1).max() <= REACHED
    assert not changes.any()


def test_farias_law():
    limits = {
        "response": np.ones(1), "turn_response": np.array([1.5]), "speed": np.ones(1), "turn_rate": np.ones(1) * 9
    }  # fmt: skip
    bearing, distance = 0.7, 0.3
    way = distance * np.array([[math.cos(bearing), math.sin(bearing)]])
    twist = drive(way, np.zeros(1), np.full(1, np.nan), **limits)
    np.testing.assert_allclose(twist, [[distance * (math.pi - bearing) / math.pi, 1.5 * math.sin(bearing)]])


def test_position_and_velocity_robots():
    control = PositionController((CRAZYFLIE, TELLO, TELLO))
    goal = np.array([[1.0, 2.0, 0.8], [0.3, -0.1, 0.9], [9.0, -9.0, 0.8]])
    toward = np.array([0.4, math.pi - 0.1, np.nan])
    position, yaw = np.array([[0, 0, 0.8], [0, 0, 0.8], [0, 0, 0.8]]), np.array([0.0, -math.pi + 0.1, 1.0])
    setpoint = control.setpoint(goal, toward, position, yaw)
    np.testing.assert_array_equal(setpoint[0], [1.0, 2.0, 0.8, 0.4])
    np.testing.assert_allclose(setpoint[1], [0.3, -0.1, 0.1, -0.2], atol=1e-12)  # the short way round
    np.testing.assert_allclose(setpoint[2], [1.0, -1.0, 0.0, 0.0])


@FEW
@given(SEEDS)
def test_rows_are_controlled_as_if_each_were_alone(seed):
    rng = np.random.default_rng(seed)
    kinds = tuple(rng.choice(list(KINDS.values()), 6))
    goal, position = rng.uniform(-1, 1, (2, 6, 3))
    near = rng.random(6) < 0.3
    goal[near] = position[near] + 0.001
    yaw, toward = rng.uniform(-4, 4, (2, 6))
    toward[rng.random(6) < 0.3] = np.nan
    goal[rng.random(6) < 0.1] = np.nan
    whole = PositionController(kinds).setpoint(goal, toward, position, yaw)
    for row in range(6):
        one = slice(row, row + 1)
        alone = PositionController(kinds[one]).setpoint(goal[one], toward[one], position[one], yaw[one])
        np.testing.assert_array_equal(alone[0], whole[row])
    broken = np.isnan(goal).any(axis=1)
    assert np.isfinite(whole[~broken]).all()
    assert np.isnan(whole[broken]).any(axis=1).all()  # safety sees that and refuses it


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
@pytest.mark.parametrize("missing", ["goal", "position", "yaw"])
def test_what_is_not_known_gives_no_number_and_no_warning(kind, missing):
    given_ = {"goal": np.ones((1, 3)), "position": np.zeros((1, 3)), "yaw": np.zeros(1)}
    given_[missing] = np.full_like(given_[missing], np.nan)
    toward = np.array([0.3])
    setpoint = PositionController((kind,)).setpoint(given_["goal"], toward, given_["position"], given_["yaw"])
    if kind.takes == "position" and missing != "goal":
        np.testing.assert_array_equal(setpoint, [[1.0, 1.0, 1.0, 0.3]])
    elif kind.takes == "velocity" and missing == "yaw":
        np.testing.assert_array_equal(setpoint[0, :3], [min(kind.response, kind.speed)] * 3)
    else:
        assert np.isnan(setpoint).any()


@FEW
@given(st.floats(-50, 50))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = wrap(np.array([angle]))[0]
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


def test_wrapping_the_ends():
    np.testing.assert_array_equal(wrap(np.array([math.pi, -math.pi, 0.0])), [math.pi, math.pi, 0.0])


def test_rows_that_follow_one_another_are_a_slice():
    assert span(np.array([2, 3, 4])) == slice(2, 5)
    assert span(np.array([7])) == slice(7, 8)
    assert np.array_equal(span(np.array([0, 2])), [0, 2])
    assert np.array_equal(span(np.array([1, 0])), [1, 0])
    assert np.arange(3)[span(np.zeros(0, dtype=np.intp))].tolist() == []


def test_some_and_every_are_any_and_all():
    for mask in ([], [True], [False], [True, False], [[True, True], [True, True]]):
        array = np.array(mask, dtype=bool)
        assert (some(array), every(array)) == (array.any(), array.all())
