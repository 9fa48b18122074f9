"""The twin behind the body's seam: rows are independent of who shares their process, and what nature adds is exact."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agents.body.external_pose import SMOOTHING_S, External
from agents.body.interface import BodyError, Disturbance, Jitter
from agents.body.kinds import KINDS
from agents.plugins.registry import load
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, Rates, Robot
from twins.body import CATCH_UP_S, TwinBody

DT = 0.01
NATURE = {
    "all": Disturbance(position_sigma=0.001, yaw_sigma=0.01),
    "crazyflie": Disturbance(hover_jitter=Jitter(0.01)),
    "F2": Disturbance(latency_s=0.03, hover_jitter=Jitter(0.02, 0.2)),
    "G1": Disturbance(latency_s=0.05, odometry_drift=0.01),
    "T": Disturbance(latency_s=0.02),
    "G3": Disturbance(position_sigma=0.0, odometry_drift=0.003),
}
MIXED = {
    "F1": Robot(kind="crazyflie", start=[0.1, 0.2, 0.3], hover=0.5),
    "G1": Robot(kind="khepera4", start=[-0.5, 0.2, 1.0]),
    "T": Robot(kind="tello", start=[0.5, 0.5, -1.0], hover=0.6),
    "G2": Robot(kind="turtlebot3", start=[0.4, -0.2]),
    "F2": Robot(kind="crazyflie", start=[0.0, 0.0], hover=0.7),
    "G3": Robot(kind="khepera4", start=[0.0, -0.7, 2.0]),
}


def request(robots, nature=None, seeds=(3,), hz=100.0):
    experiment = Experiment(
        title="Bodies", robots=robots, duration_s=1.0, disturbance=nature or {}, rates=Rates(body_hz=hz)
    )
    return bodies.body_request(experiment, tuple(robots), seeds)


def body(kind, **parts):
    """One twin that stands at the origin."""
    hover = 0.5 if KINDS[kind].flies else None
    return TwinBody(request({"R": Robot(kind=kind, start=[0.0, 0.0], hover=hover)}, **parts))


def up(twin, height=0.5):
    """Takes off and waits; returns the tick that comes next."""
    twin.read(0.0)
    twin.takeoff(np.array([0]), np.array([height]))
    for tick in range(1, 500):
        twin.read(tick * DT)
    return 500


def exercise(groups):
    """Six robots driven through a take-off, a flight, an emergency stop and a landing, in these groups: all states."""
    whole = request(MIXED, NATURE)
    parts = [(np.array(group), TwinBody(whole.select(np.array(group)))) for group in groups]
    rng = np.random.default_rng(5)
    fields = ("position", "velocity", "yaw", "true_position", "true_yaw", "battery", "flying")
    history = {field: [] for field in fields}
    for tick in range(400):
        command = rng.uniform([-0.5, -0.5, 0.0, -0.5], [0.5, 0.5, 1.0, 0.5], (6, 4))
        command[rng.random(6) < 0.2] = np.nan
        ordered = {"takeoff": [0, 2, 4] if tick == 10 else [], "land": [1, 4] if tick == 250 else []}
        ordered["stop"] = [3, 0] if tick == 300 else []
        moment = {field: [None] * 6 for field in fields}
        for rows, twin in parts:
            state = twin.read(tick * DT)
            for what, who in ordered.items():
                mine = np.flatnonzero(np.isin(rows, who))
                if len(mine):
                    getattr(twin, what)(*((mine, np.full(len(mine), 0.6)) if what == "takeoff" else (mine,)))
            twin.command(command[rows])
            for field in fields:
                for row, value in zip(rows, getattr(state, field), strict=True):
                    moment[field][row] = np.array(value)
        for field in fields:
            history[field].append(moment[field])
    return {field: np.array(values) for field, values in history.items()}


@pytest.mark.slow
def test_rows_of_one_body_are_separate_bodies_to_the_last_bit():
    together = exercise([range(6)])
    for groups in ([[row] for row in range(6)], [[5, 0, 3], [2], [4, 1]]):
        apart = exercise(groups)
        for field, values in together.items():
            np.testing.assert_array_equal(apart[field], values, err_msg=field)
    assert together["flying"].any(axis=0).tolist() == [True, False, True, False, True, False]
    moved = np.linalg.norm(together["true_position"][-1] - together["true_position"][0], axis=1)
    assert (moved > 0.01).all()


def test_repetitions_side_by_side_are_what_they_are_alone():
    both = TwinBody(request(MIXED, NATURE, seeds=(3, 4)))
    alone = [TwinBody(request(MIXED, NATURE, seeds=(seed,))) for seed in (3, 4)]
    command = np.tile([0.2, 0.5, 0.4, 0.1], (6, 1))
    for tick in range(100):
        states = [twin.read(tick * DT) for twin in alone]
        merged = both.read(tick * DT)
        for field in ("position", "yaw", "true_position"):
            expected = np.concatenate([getattr(state, field) for state in states])
            np.testing.assert_array_equal(getattr(merged, field), expected)
        if tick == 0:
            for twin, rows in ((both, [0, 2, 4, 6, 8, 10]), (alone[0], [0, 2, 4]), (alone[1], [0, 2, 4])):
                twin.takeoff(np.array(rows), np.full(len(rows), 0.5))
        both.command(np.tile(command, (2, 1)))
        for twin in alone:
            twin.command(command)
    assert not np.array_equal(merged.position[:6], merged.position[6:])


def test_a_state_that_was_read_does_not_change_afterwards():
    twin = body("khepera4")
    first = twin.read(0.0)
    kept = first.true_position.copy()
    twin.command(np.array([[0.2, 0.0, 0.0, 0.0]]))
    later = twin.read(0.5)
    np.testing.assert_array_equal(first.true_position, kept)
    assert later.true_position[0, 0] > 0.05
    assert twin.read(0.5) is later  # nothing new in the same tick: no new noise either


@pytest.mark.parametrize("ticks", [0, 1, 4])
def test_latency_from_command_to_effect(ticks):
    twin = body("khepera4", nature={"all": Disturbance(latency_s=ticks * DT)})
    speed = []
    for tick in range(12):
        twin.read(tick * DT)
        speed.append(twin.engine.velocity[0, 0])
        twin.command(np.array([[0.01, 0.0, 0.0, 0.0]]))  # at tick 0 first
    np.testing.assert_allclose(speed, [0.0] * (1 + ticks) + [0.01] * (11 - ticks))


@pytest.mark.parametrize("latency", [None, 0.05])
def test_what_is_left_alone_climbs_by_itself_with_latency_too(latency):
    twin = body("crazyflie", nature={"all": Disturbance(latency_s=latency)})
    twin.read(0.0)
    twin.command(np.array([[1.0, 1.0, 1.0, 0.0]]))  # on the ground: of no effect, now or later
    for tick in range(1, 20):
        twin.read(tick * DT)
    twin.takeoff(np.array([0]), np.array([0.5]))
    for tick in range(20, 600):
        state = twin.read(tick * DT)
        twin.command(np.full((1, 4), np.nan))
    np.testing.assert_allclose(state.true_position, [[0.0, 0.0, 0.5]], atol=1e-3)


def test_hover_jitter_fades_on_the_way_down():
    twin = body("crazyflie", nature={"all": Disturbance(hover_jitter=Jitter(0.01))})
    ground = np.array([twin.read(tick * DT).true_position[0, :2] for tick in range(50)])
    assert not ground.any()
    tick = 50
    twin.takeoff(np.array([0]), np.array([0.5]))
    air = np.array([twin.read((tick + k) * DT).true_position[0, :2] for k in range(3000)])
    assert air[500:].std() == pytest.approx(0.01, rel=0.3)
    twin.land(np.array([0]))
    for k in range(600):
        state = twin.read((tick + 3000 + k) * DT)
    np.testing.assert_array_equal(state.true_position, np.zeros((1, 3)))
    assert not state.flying[0]


def test_measurement_noise_is_not_the_truth_and_ground_robots_have_no_height():
    twin = body("khepera4", nature={"all": Disturbance(position_sigma=0.002, yaw_sigma=0.01)})
    states = [twin.read(tick * DT) for tick in range(2000)]
    error = np.array([state.position[0] - state.true_position[0] for state in states])
    np.testing.assert_allclose(error.std(axis=0), [0.002, 0.002, 0.0], rtol=0.05)
    turn = np.array([state.yaw[0] - state.true_yaw[0] for state in states])
    assert turn.std() == pytest.approx(0.01, rel=0.05)
    assert states[-1].time[0] == 1999 * DT


@pytest.mark.slow
def test_velocity_is_measured_as_that_of_robots_in_motion_capture():
    nature = {"all": Disturbance(position_sigma=0.001, hover_jitter=Jitter(0.01))}
    twin, seen = body("crazyflie", nature=nature), External(1)
    seen.update(0, 0.0, twin.read(0.0).position[0], 0.0)
    twin.takeoff(np.array([0]), np.array([0.5]))
    for tick in range(1, 800):
        state = twin.read(tick * DT)
        seen.update(0, tick * DT, state.position[0], 0.0)
        np.testing.assert_allclose(state.velocity, seen.velocity, rtol=0.0, atol=1e-12)
    velocity = np.array([twin.read((800 + tick) * DT).velocity[0] for tick in range(6000)])
    wobble = 0.01 / SMOOTHING_S * np.sqrt(SMOOTHING_S / (0.5 + SMOOTHING_S))  # of an Ornstein-Uhlenbeck process
    np.testing.assert_allclose(velocity[:, :2].std(axis=0), np.hypot(wobble, 0.001 / SMOOTHING_S), rtol=0.1)
    assert velocity[:, 2].std() == pytest.approx(0.001 / SMOOTHING_S, rel=0.1)  # noise alone
    assert not twin.engine.velocity[:, :2].any()  # its controller holds its place


def test_velocity_of_a_robot_that_drives_and_of_one_that_is_put_elsewhere():
    twin = body("khepera4")
    for tick in range(200):
        state = twin.read(tick * DT)
        twin.command(np.array([[0.2, 0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(state.velocity, [[0.2, 0.0, 0.0]], atol=1e-6)
    twin.place(np.array([0]), np.array([[1.0, 1.0, 0.0]]), np.zeros(1), np.zeros(1, dtype=bool))
    assert not twin.read(199 * DT).velocity.any()
    assert not twin.read(200 * DT).velocity.any()


@pytest.mark.slow
def test_odometry_drifts_with_the_way():
    errors = []
    for seed in range(40):
        twin = body("khepera4", nature={"all": Disturbance(odometry_drift=0.02)}, seeds=(seed,))
        for tick in range(300):
            state = twin.read(tick * DT)
            twin.command(np.array([[0.2, 0.5, 0.0, 0.0]]))
        errors.append(state.position[0, :2] - state.true_position[0, :2])
    way = 0.2 * 3.0
    assert np.std(errors) == pytest.approx(0.02 * np.sqrt(way), rel=0.2)


def test_land_and_stop_on_the_ground_halt_the_wheels():
    for order in ("land", "stop"):
        twin = body("turtlebot3")
        for tick in range(50):
            twin.read(tick * DT)
            twin.command(np.array([[0.2, 0.0, 0.0, 0.0]]))
        getattr(twin, order)(np.array([0]))
        for tick in range(50, 80):
            twin.read(tick * DT)
        assert not twin.engine.velocity.any()


def test_an_emergency_stop_in_the_air_is_a_fall():
    twin = body("crazyflie")
    tick = up(twin)
    twin.stop(np.array([0]))
    heights = [twin.read((tick + k) * DT).true_position[0, 2] for k in range(60)]
    assert heights[10] > 0.3
    assert heights[-1] == 0.0


def test_a_process_that_was_frozen_resumes_where_it_was():
    twin = body("khepera4")
    twin.read(0.0)
    twin.command(np.array([[0.2, 0.0, 0.0, 0.0]]))
    before = twin.read(0.2).true_position[0, 0]
    late = twin.read(0.2 + CATCH_UP_S + 5.0).true_position[0, 0]
    assert late - before == pytest.approx(0.2 * DT)
    np.testing.assert_allclose(twin.read(6.3).time, 6.3)


def test_missed_ticks_are_made_up_for():
    every, some = body("crazyflie"), body("crazyflie")
    for twin, times in ((every, range(1, 401)), (some, (3, 4, 50, 120, 121, 200, 290, 310, 400))):
        twin.read(0.0)
        twin.takeoff(np.array([0]), np.array([0.5]))
        for tick in times:
            state = twin.read(tick * DT)
        twin.last = state
    np.testing.assert_array_equal(every.last.true_position, some.last.true_position)


def test_batteries():
    twin = body("crazyflie")
    assert twin.read(0.0).battery[0] == 1.0
    for tick in range(1, 101):
        state = twin.read(tick * DT)
    assert state.battery[0] == 1.0  # motors off
    twin.takeoff(np.array([0]), np.array([0.5]))
    for tick in range(101, 301):
        state = twin.read(tick * DT)
    assert state.battery[0] == pytest.approx(1.0 - 2.0 / KINDS["crazyflie"].endurance_s)
    rover = body("khepera4")
    for tick in range(1, 101):
        state = rover.read(tick * DT)
    assert state.battery[0] == pytest.approx(1.0 - 1.0 / KINDS["khepera4"].endurance_s, abs=1e-6)


def test_every_kind_has_a_twin_and_a_stranger_has_none():
    for kind in KINDS:
        assert body(kind).read(0.0).position.shape == (1, 3)
    whole = request({"R": Robot(kind="khepera4", start=[0.0, 0.0])})
    submarine = replace(KINDS["khepera4"], name="submarine")
    with pytest.raises(BodyError, match="no twin of 'submarine'; add it to RESPONSES"):
        TwinBody(replace(whole, kinds=(submarine,)))


def test_the_twin_is_registered():
    twin = load("zenpark.bodies", "twin")(request(MIXED))
    assert isinstance(twin, TwinBody)
    twin.open()
    twin.close()


@pytest.mark.parametrize("word", ["sigma", "hover_jitters"])
def test_disturbances_are_checked(word):
    with pytest.raises(msgspec.ValidationError, match=word):
        msgspec.convert({word: 1.0}, Disturbance)
