"""Robots that move against their commands end a run, with the probable cause; right ones raise no alarm."""

import math

import numpy as np
import pytest

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS
from agents.safety.direction_check import DirectionCheck
from agents.safety.hazards import Cause, Outcome, failed
from experiments.definition.experiment import LegTable, RobotTable
from experiments.file import document
from tests.experiments.virtual_time.evaluators import evaluated
from tests.small import small
from twins.models.differential import Differential
from twins.models.onboard_flight import OnboardFlight
from twins.models.quadrotor import Quadrotor

drones = pytest.mark.parametrize("kind", ["crazyflie", "tello"])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turn_of_the_wrong_sign_fails_a_run(sign, monkeypatch):
    right = Differential.command
    monkeypatch.setattr(Differential, "command", lambda self, s: right(self, (s[0], sign * s[1], s[2], s[3])))
    log, _ = evaluated(document.load("triangle").cases()["event"].experiment, compiled=False)
    found = {row: each for row, each in log.incidents if each.cause == Cause.STRAYING}
    assert sorted(found) == ([] if sign > 0.0 else [0, 1])
    for each in found.values():
        assert failed(each.text)
        assert each.text.endswith("is the sign of its turn wrong, are its wheels swapped?")


def flown(drone, disturbance, **plan):
    """Log of a drone that begins a plan after a second."""
    robot = RobotTable(kind=drone, start=[0.0, 0.0], hover=0.8)
    legs = [LegTable(at_s=1.0, robot="A", plan=plan)]
    experiment = small({"A": robot}, duration_s=12.0, timeline=legs, disturbance={"all": disturbance})
    return evaluated(experiment, compiled=False)[0]


def command_of(axes, right=OnboardFlight.command):
    """Commands to a drone with other axes: both rows of the matrix that turns a commanded way."""

    def command(self, setpoint):
        at = np.zeros(2) if self._by_velocity else np.array(self.held[:2])
        x, y = at + np.array(axes) @ (np.array(setpoint[:2]) - at)
        right(self, (x, y, *setpoint[2:]))

    return command


@drones
@pytest.mark.parametrize("axes", [((0, 1), (1, 0)), ((0, -1), (-1, 0)), ((-1, 0), (0, 1)), ((-1, 0), (0, -1))])
def test_drone_with_wrong_axes_lands_near_its_place(axes, kind, monkeypatch):
    """A drone that took north for east flew 1.2 m before it landed."""
    monkeypatch.setattr(OnboardFlight, "command", command_of(axes))
    log = flown(kind, Disturbance(position_sigma=0.0005), kind="line", move_by=[0.6, -0.8], speed=0.3)
    ((_, found),) = [each for each in log.incidents if each[1].outcome >= Outcome.LAND]
    assert found.cause == Cause.STRAYING
    assert found.text.endswith("are its axes swapped or mirrored?")
    off = np.hypot(*(log.true_position - log.goal)[log.time < found.time, 0, :2].T)
    assert np.nanmax(off) < 0.6


@drones
@pytest.mark.parametrize(("radius", "period_s"), [(0.3, 4.0), (0.3, 6.0), (0.5, 12.0)])
def test_steady_wind_is_no_fault(radius, period_s, kind):
    """A drone on a circle, with an error of its place by which it holds the wind, was landed."""
    wind = [0.65, -0.75] if kind == "crazyflie" else [0.4, -0.5]
    log = flown(kind, Disturbance(position_sigma=0.0005, wind=wind), kind="circle", radius=radius, period_s=period_s)
    assert not log.incidents


def assert_right(kind, duration_s, x_at, late_s=0.0, wind=0.0):
    """Fly a right drone to places `x_at` a time, by late positions and in a wind [m/s²]: no check fails."""
    dt, figures = 0.01, KINDS[kind]
    motion, check = Quadrotor(figures, (0.0, 0.0, 0.8), 0.0), DirectionCheck(figures)
    motion.place((0.0, 0.0, 0.8), 0.0, flying=True)
    motion.blow((wind, 0.0))
    seen = []
    for tick in range(round(duration_s / dt)):
        seen.append((motion.position, motion.velocity))
        position, velocity = seen[max(0, tick - round(late_s / dt))]
        by_position, x = figures.takes == "position", x_at(tick * dt)
        setpoint = (x, 0.0, 0.8, 0.0) if by_position else (figures.response * (x - position[0]), 0.0, 0.0, 0.0)
        if tick * dt >= check.due:
            check.update(tick * dt, setpoint[0], 0.0, position, velocity)
        assert not check.against
        motion.command(setpoint)
        motion.move(dt)


@pytest.mark.parametrize(("hz", "late_s"), [(2.0, 0.3), (3.0, 0.2), (4.0, 0.1), (4.0, 0.2), (5.0, 0.1)])
@drones
def test_late_shaken_drone_is_not_mirrored(hz, late_s, kind):
    """A right drone whose law shook was landed: late, it accelerates against the commands of the moment."""
    assert_right(kind, 5.0, lambda t: 0.6 * math.sin(math.tau * hz * t), late_s=late_s)


@pytest.mark.parametrize(("way", "period_s"), [(0.2, 4.0), (0.5, 6.0), (1.0, 8.0)])
@drones
def test_gentle_way_with_a_wind_is_not_mirrored(way, period_s, kind):
    """A right drone in the wind of the case `integral` was landed."""
    wind = 0.8 if kind == "crazyflie" else 0.6
    assert_right(kind, 15.0, lambda t: way * (1.0 - math.cos(math.tau * max(t - 5.0, 0.0) / period_s)), wind=wind)
