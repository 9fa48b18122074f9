"""Twins behind the interface of bodies: a robot is the same alone and in company, and disturbances are exact."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from agents.body.external_pose import External
from agents.body.interface import BodyError, Disturbance, Jitter
from agents.body.kinds import KINDS
from agents.plugins.registry import load
from agents.vectors import NO_SETPOINT, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.requests import request
from twins.body import CATCH_UP_S, TwinBody, instants
from twins.engines.engine import World
from twins.engines.point_mass import PointMass
from twins.engines.pymunk_engine import Planar
from twins.scene import Scene

DT = 0.01
AHEAD = (0.2, 0.0, 0.0, 0.0)
DISTURBED = {
    "R0": Disturbance(position_sigma=0.001, yaw_sigma=0.01, hover_jitter=Jitter(0.01)),
    "R1": Disturbance(position_sigma=0.001, latency_s=0.05, odometry_drift=0.01),
    "R2": Disturbance(position_sigma=0.001, latency_s=0.02, hover_jitter=Jitter(0.01)),
    "R3": Disturbance(yaw_sigma=0.01),
}
STARTS = ((0.1, 0.2), (-0.5, 0.2), (0.5, 0.5), (0.4, -0.2))
FIELDS = ("time", "position", "velocity", "yaw", "true_position", "true_yaw", "battery", "flying")


def body(kind, disturbance=None, seed=3):
    return TwinBody(request([kind], disturbance=disturbance, seeds=[seed]))


def advance(twin, ticks, first=0, command=None, take_off=False):
    """(ticks, 3) true positions; the state is the body's own."""
    path = []
    if take_off:
        twin.takeoff([0], [0.5])
    for tick in range(first, first + ticks):
        (state,) = twin.read(tick * DT)
        if command is not None:
            twin.command([command])
        path.append(state.true_position)
    return np.array(path), state


def exercise(groups):
    """States of four robots in these groups: take-off, flight, emergency stop and landing."""
    kinds = (CRAZYFLIE, KHEPERA4, TELLO, TURTLEBOT3)
    whole = request(kinds, start=STARTS, yaw=(0.3, 1.0, -1.0, 0.0), disturbance=DISTURBED)
    parts = [(rows, TwinBody(whole.select(rows))) for rows in groups]
    rng = np.random.default_rng(5)
    orders = {10: ("takeoff", (0, 2), [0.6]), 250: ("land", (1, 2)), 300: ("stop", (3, 0))}
    history = []
    for tick in range(400):
        commands = rng.uniform([-0.5, -0.5, 0.0, -0.5], [0.5, 0.5, 1.0, 0.5], (4, 4)).tolist()
        moment = {}
        for rows, twin in parts:
            states = twin.read(tick * DT)
            if tick in orders:
                order, robots, *height = orders[tick]
                ordered = [k for k, row in enumerate(rows) if row in robots]
                getattr(twin, order)(ordered, *(each * len(ordered) for each in height))
            twin.command([tuple(commands[row]) for row in rows])
            for row, state in zip(rows, states, strict=True):
                moment[row] = [getattr(state, field) for field in FIELDS]
        history.append([moment[row] for row in range(4)])
    return history


@pytest.mark.slow
def test_robots_are_the_same_alone():
    together = exercise([range(4)])
    for groups in ([[row] for row in range(4)], [[3, 0], [2, 1]]):
        assert exercise(groups) == together
    assert [any(moment[row][-1] for moment in together) for row in range(4)] == [True, False, True, False]


@pytest.mark.parametrize("ticks", [0, 4])
def test_latency_from_command_to_effect(ticks):
    twin = body(KHEPERA4, Disturbance(latency_s=ticks * DT))
    path = advance(twin, 12, command=(0.01, 0.0, 0.0, 0.0))[0][:, 0]  # at tick 0 first
    assert np.diff(path) == pytest.approx([0.0] * ticks + [1e-4] * (11 - ticks))
    twin = body(CRAZYFLIE, Disturbance(latency_s=ticks * DT))
    advance(twin, 1, command=(1.0, 1.0, 1.0, 0.0))  # on the ground: of no effect, now or later
    advance(twin, 19, 1)
    path, _ = advance(twin, 580, 20, NO_SETPOINT, take_off=True)
    assert path[-1] == pytest.approx([0.0, 0.0, 0.5], abs=1e-3)


def test_hover_jitter_fades_on_the_way_down():
    twin = body(CRAZYFLIE, Disturbance(hover_jitter=Jitter(0.01)))
    assert advance(twin, 3000, take_off=True)[0][500:, :2].std() == pytest.approx(0.01, rel=0.3)
    twin.land([0])
    _, state = advance(twin, 600, 3000)
    assert (state.true_position, state.flying) == (ZERO, False)


@pytest.mark.parametrize("engine", [PointMass(), Planar()], ids=["point-mass", "pymunk"])
def test_wind_pushes_flying_robots_by_their_loops_error(engine):
    world = World(Scene.empty(), engine, ((),) * 2, 1.0, (False,) * 2)
    windy = Disturbance(wind=(0.8, -0.3))
    twin = TwinBody(request((CRAZYFLIE, KHEPERA4), start=STARTS[:2], disturbance=windy), world)
    twin.takeoff([0], [0.5])
    for tick in range(1200):
        flying, standing = twin.read(tick * DT)
    assert flying.true_position == pytest.approx((0.1 + 0.08, 0.2 - 0.03, 0.5), abs=1e-3)
    assert standing.true_position == (*STARTS[1], 0.0)


def test_ground_robots_measure_no_height():
    twin = body(KHEPERA4, Disturbance(position_sigma=0.002, yaw_sigma=0.01))
    measured = []
    for tick in range(2000):
        (state,) = twin.read(tick * DT)
        measured.append((*state.position, state.yaw))
    assert twin.read(tick * DT)[0].position == measured[-1][:3]  # nothing changes within a tick, nor the noise
    np.testing.assert_allclose(np.std(measured, axis=0), [0.002, 0.002, 0.0, 0.01], rtol=0.05)


def test_velocity_is_that_of_motion_capture():
    twin, seen = body(CRAZYFLIE, Disturbance(position_sigma=0.001, hover_jitter=Jitter(0.01))), External()
    seen.update(0.0, twin.read(0.0)[0].position, 0.0)
    twin.takeoff([0], [0.5])
    for tick in range(1, 300):
        (state,) = twin.read(tick * DT)
        seen.update(tick * DT, state.position, 0.0)
        assert state.velocity == pytest.approx(seen.velocity, rel=0.0, abs=1e-12)
    assert np.abs(state.velocity).min() > 0.0
    assert twin.engine.motions[0].velocity[:2] == (0.0, 0.0)  # its controller holds its place


def test_placed_robot_rests_or_moves_as_commanded():
    twin = body(KHEPERA4)
    _, state = advance(twin, 200, command=AHEAD)
    assert state.velocity == pytest.approx((0.2, 0.0, 0.0), abs=1e-6)
    twin.place([0], [(1.0, 1.0, 0.0)], [0.0], [False])
    for tick in (199, 200):
        assert twin.read(tick * DT)[0].velocity == ZERO
    twin.place([0], [(1.0, 1.0, 0.0)], [0.0], [False], [(0.1, 0.5, 0.0)])
    assert twin.read(200 * DT)[0].velocity == (0.1, 0.5, 0.0)
    assert twin.read(201 * DT)[0].true_position == pytest.approx((1.001, 1.0, 0.0))  # wheels roll ahead alone


def test_odometry_drifts_with_the_way():
    twin = body(KHEPERA4, Disturbance(odometry_drift=0.02))
    _, state = advance(twin, 300, command=AHEAD)
    errors, before = np.subtract(state.position, state.true_position)[:2], state.true_position[0]
    assert 0.001 < np.abs(errors).min() < np.abs(errors).max() < 0.05
    (state,) = twin.read(2.99 + CATCH_UP_S + 5.0)  # a frozen process resumes where it was
    assert state.true_position[0] - before == pytest.approx(0.2 * DT)
    assert twin.read(9.1)[0].time == 9.1


def test_stop_halts_wheels_and_is_a_fall_aloft():
    for order in ("land", "stop"):
        twin = body(TURTLEBOT3)
        advance(twin, 50, command=AHEAD)
        getattr(twin, order)([0])
        advance(twin, 30, 50)
        assert twin.engine.motions[0].velocity == ZERO
    twin = body(CRAZYFLIE)
    advance(twin, 500, take_off=True)
    twin.stop([0])
    height = advance(twin, 60, 500)[0][:, 2]
    assert (height[10] > 0.3, height[-1]) == (True, 0.0)


def test_missed_ticks_and_substeps_are_made_up_for():
    asked, ends = request((CRAZYFLIE,), disturbance=Disturbance(hover_jitter=Jitter(0.01))), set()
    for twin, times in (
        (TwinBody(asked), range(1, 401)),
        (TwinBody(asked), (3, 4, 50, 120, 121, 200, 290, 310, 400)),
        (TwinBody(replace(asked, rate_hz=50.0), substeps=2), range(2, 401, 2)),
    ):
        twin.read(0.0)
        twin.takeoff([0], [0.5])
        ends.add([twin.read(tick * DT)[0].true_position for tick in times][-1])
    assert len(ends) == 1
    assert instants(1.0, 1.03, 0.01) == pytest.approx([1.01, 1.02, 1.03])


def test_batteries_last_as_the_kind_says():
    twin = body(CRAZYFLIE)
    assert advance(twin, 101)[1].battery == 1.0  # motors off
    flown = advance(twin, 200, 101, take_off=True)[1].battery
    assert flown == pytest.approx(1.0 - 2.0 / CRAZYFLIE.endurance_s)
    assert advance(body(KHEPERA4), 101)[1].battery == pytest.approx(1.0 - 1.0 / KHEPERA4.endurance_s, abs=1e-6)


def test_external_pose_replaces_the_measured_one():
    twin = TwinBody(replace(request((KHEPERA4,) * 2), external=(True, False)))
    twin.locate(0, 0.0, (3.0, 2.0, 0.0), 0.5)
    first, second = twin.read(DT)
    assert (first.position, first.yaw, first.time) == ((3.0, 2.0, 0.0), 0.5, 0.0)
    assert (first.true_position, second.position) == (ZERO, (0.0, 1.0, 0.0))


def test_mirrored_robot_is_where_it_is_shown():
    world = World(Scene.empty(), PointMass(), ((), ()), 1.0, (False, True))
    twin = TwinBody(request((KHEPERA4, CRAZYFLIE)), world)
    assert np.isnan(twin.read(DT)[1].position).all()
    twin.mirror([1], [(1.0, 2.0, 0.5)], [0.3], [(0.1, 0.0, 0.0)])
    twin.takeoff([1], [0.8])  # orders have no effect on it
    for tick in range(2, 9):
        _, seen = twin.read(tick * DT)
    found = (seen.true_position, seen.true_yaw, seen.flying, seen.velocity)
    assert found == ((1.0, 2.0, 0.5), 0.3, False, ZERO)


def test_every_kind_has_a_registered_twin():
    twin = load("zenpark.bodies", "twin")(request([*KINDS], start=STARTS[:1] * len(KINDS)))
    assert isinstance(twin, TwinBody)
    twin.open()
    assert [state.true_position for state in twin.read(0.0)] == [(*STARTS[0], 0.0)] * len(KINDS)
    twin.close()
    with pytest.raises(BodyError, match="no twin of 'submarine'; give the kind a `motion`"):
        body(replace(KHEPERA4, name="submarine", motion=None))


def test_quiet_robot_needs_no_numpy():
    program = """
import sys
from bridges.crazyflie.kind import CRAZYFLIE
from tests.requests import request
from twins.body import TwinBody
body = TwinBody(request((CRAZYFLIE,)))
body.takeoff([0], [0.5])
for tick in range(9):
    body.read(0.01 * tick)
    body.command([(0.1, 0.0, 0.5, 0.0)])
sys.exit("numpy" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
