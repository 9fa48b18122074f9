"""What is transmitted: poses smoothed without lag; and when control is computed anew: when the law's input changed."""

from math import floor, inf, isnan, log, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.decision.control_updates import ControlUpdates
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.transmission import LowPass, Transmitter
from agents.plugins.predictors import HOLD, ConstantVelocity
from agents.plugins.triggers import SendOnDelta
from agents.vectors import NO_SETPOINT, UNKNOWN, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from experiments.definition.experiment import Formation, LegTable
from tests.agents.bench import Swarm
from tests.cases import examples
from tests.small import changed, triangle

DT = 0.02


def say(transmitter, t, position, velocity=ZERO):
    return transmitter.transmits(t, position, velocity, 0.0, 0.0, t, ZERO, NO_SETPOINT)


@examples(25)
@given(st.floats(0.05, 2.0), st.floats(-0.5, 0.5))
def test_low_pass_does_not_lag(constant, speed):
    smooth, velocity = LowPass(KHEPERA4), (speed, 0.0, 0.0)
    for k in range(200):
        smooth.smooth(k * DT, (speed * k * DT, 0.0, 0.0), velocity, constant, NO_SETPOINT)
    assert smooth.position == pytest.approx((speed * 199 * DT, 0.0, 0.0), abs=1e-12)
    assert smooth.velocity == pytest.approx(velocity, abs=1e-12)


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_drones_are_carried_by_their_setpoints(kind):
    rng, speed, wobble = np.random.default_rng(2), 0.2, np.zeros(2)
    smooth, off, x = LowPass(kind), [], 0.0
    for k in range(9000):
        wobble = 0.96 * wobble + 0.28 * rng.normal(0.0, 0.01, 2)
        setpoint = (x + speed / kind.response, 0.0, 0.0, 0.0) if kind is CRAZYFLIE else (speed, 0.0, 0.0, 0.0)
        measured = (x + float(wobble[0]), float(wobble[1]), 0.0)
        smooth.smooth(k * DT, measured, (9.0 + speed, 9.0, 0.0), 0.4, setpoint)
        off.append([smooth.position[0] - x, smooth.position[1]])
        x += DT * speed
    assert np.abs(np.mean(off[2000:], axis=0)).max() < 0.003
    assert np.std(off[2000:], axis=0).max() < 0.009  # of a wobble of 0.01 m; its velocity would be 0.1 m/s and more
    free, velocity = LowPass(kind), (0.3, 0.3, 0.3)
    for k in range(200):
        free.smooth(k * DT, ZERO, velocity, 0.4, NO_SETPOINT)
    assert free.velocity == pytest.approx(velocity, abs=1e-3)  # without setpoints it is believed


def test_low_pass_begins_anew_after_a_loss():
    smooth, found = LowPass(KHEPERA4), []
    for k, place in enumerate((ZERO, UNKNOWN, (1.0, 1.0, 1.0), (2.0, 1.0, 1.0))):
        smooth.smooth(k * DT, place, ZERO, 1.0, NO_SETPOINT)
        found.append(smooth.position)
    assert found[:3] == [ZERO, pytest.approx(UNKNOWN, nan_ok=True), (1.0, 1.0, 1.0)]
    assert 1.0 < found[3][0] < 1.1


def test_smoothed_pose_is_judged_and_transmitted():
    transmitter = Transmitter(SendOnDelta(threshold=0.01, smoothing_s=0.5), HOLD, KHEPERA4)
    assert say(transmitter, 0.0, ZERO)
    quiet = 0
    while not say(transmitter, (quiet + 1) * DT, (0.1, 0.0, 0.0)):
        quiet += 1
    assert quiet == floor(-0.5 * log(0.9) / DT)
    assert transmitter.position == transmitter.asking.last.position
    assert 0.01 < transmitter.position[0] < 0.0137


def test_neither_unknown_places_nor_believed_motion_are_transmitted():
    transmitter = Transmitter(SendOnDelta(threshold=0.01), ConstantVelocity(), KHEPERA4)
    assert not say(transmitter, 0.0, UNKNOWN)
    assert transmitter.asking.last.time == -inf
    assert say(transmitter, DT, ZERO, (0.1, 0.0, 0.0))
    assert transmitter.velocity == (0.1, 0.0, 0.0)
    assert not say(transmitter, 2 * DT, (0.1 * DT, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert transmitter.position == (0.1 * DT, 0.0, 0.0)


@pytest.mark.parametrize("smoothing_s", [0.0, 0.5])
@pytest.mark.parametrize("velocity", [UNKNOWN, (60.0, 0.0, 0.0), (inf, 0.0, 0.0)])
def test_unknown_velocity_counts_as_standing(smoothing_s, velocity):
    transmitter = Transmitter(SendOnDelta(threshold=0.01, smoothing_s=smoothing_s), ConstantVelocity(), KHEPERA4)
    assert say(transmitter, 0.0, ZERO, velocity)
    assert all(map(isnan, transmitter.velocity))
    assert transmitter.asking.last.velocity == ZERO
    assert say(transmitter, 4.0, (1.0, 0.0, 0.0), velocity)


LINKS = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}


def updating(update, **parts):
    return Swarm(changed(triangle(), formation=Formation(links=LINKS, update=update), **parts)).running()


def updates(swarm):
    return [swarm.robot(name).updates for name in "ABC"]


def test_goal_changes_only_when_computed():
    assert updates(updating(None).run(4.95)) == [50, 50, 50]
    swarm = updating({"kind": "periodic", "period_s": 0.5})
    begin = swarm.tick
    goals = swarm.run(5.0).column("A", "goal", begin - 1)
    changes = [k for k in range(1, len(goals)) if goals[k] != goals[k - 1]]
    assert all(k % 50 == 0 for k in changes)
    assert updates(swarm)[0] == len(changes) + 1


def test_held_robot_or_lost_neighbour_makes_it_compute():
    swarm = updating({"kind": "periodic", "period_s": 30.0}).run(1.0)
    robot, before = swarm.robot("A"), updates(swarm)
    assert robot.hold() == ""
    held = swarm.run(0.5).last("A", "goal")
    assert robot.start(0.0) == ""
    assert swarm.run(0.3).last("A", "goal") != held
    between = updates(swarm)
    assert between[0] > before[0]
    swarm.lose("B", "A", since=5.0)
    assert updates(swarm.run(0.2))[0] == between[0] + 1
    assert updates(swarm)[1] == before[1] == 1


def test_follower_with_a_plan_always_computes():
    leg = LegTable(at_s=0.0, robot="A", plan={"kind": "hold", "at": [0.0, 0.2]})
    assert updates(updating({"kind": "periodic", "period_s": 30.0}, timeline=[leg]).run(1.95)) == [20, 1, 20]


@pytest.mark.parametrize("anchored", [False, True])
def test_deviation_is_the_largest_change_on_a_link(anchored):
    neighbours = Neighbours([Incoming(k, name, KHEPERA4, 0.5) for k, name in enumerate("BC")], 1.0)
    control = ControlUpdates(SendOnDelta(threshold=0.05), 2, anchored=anchored)
    for link in range(2):
        neighbours.mark_alive(link)
        neighbours.receive(link, (1.0, float(link), 0.0), (0.1, 0.0, 0.0), 0.0, 0.0)
    neighbours.update_active(0.0)

    def due(t, x, predictor=HOLD):
        place = (x, 0.0, 0.0)
        return control.due(t, place, ZERO, neighbours, predictor, since_start=t, offset=ZERO, error=0.0, energy=0.0)

    assert due(0.0, 0.0)
    assert not due(0.1, nan)
    neighbours.receive(1, (1.04, 1.0, 0.0), ZERO, 0.1, 0.1)
    assert not due(0.1, 0.0)
    assert control.asking.view.deviation == pytest.approx(0.04)
    assert due(0.2, -0.03)
    assert control.asking.view.deviation == pytest.approx(0.07)
    assert not due(0.3, 0.01)  # 4 cm on both links
    assert due(1.0, 0.01, ConstantVelocity())  # the first sender is believed to have moved on
