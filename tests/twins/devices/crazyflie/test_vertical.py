"""Heights of the Crazyflie twin: figures of the maker's firmware, compiled and run on a rigid body."""

from dataclasses import replace

import numpy as np
import pytest

from tests.requests import request
from tests.twins.crazyflie_wire import DT, Wire, brushless
from twins.devices.crazyflie.vehicle import Vehicle
from twins.devices.device import Faults


def heights(wire, seconds, each=None):
    return np.array([wire.after(DT, each).position[2] for _ in range(round(seconds / DT))])


def advance(vehicles, t):
    """Their heights [m] at a time."""
    for vehicle in vehicles:
        vehicle.advance(t)
    return [vehicle.model.held[2] for vehicle in vehicles]


@pytest.mark.slow
def test_take_off_overshoots_and_returns():
    """By 7 to 11 %, for 10 to 15 s: the integral of the height was charged on the floor and on the way."""
    climbs = [(0.5, 1.5), (0.8, 2.0), (1.0, 2.5), (1.0, 2.0), (2.0, 5.0)]
    asked = request("crazyflie", ["x"] * 2 * len(climbs))
    platforms = ({"platform": platform} for platform in ("crazyflie", "brushless") for _ in climbs)
    asked = replace(asked, device=tuple(platforms))
    vehicles = [Vehicle(asked, Faults(), row) for row in range(2 * len(climbs))]
    assert all(vehicle.arm(on=True) for vehicle in vehicles[len(climbs) :])
    begin, at = 0.6, np.zeros(4)  # the motors of those that are armed spin up
    for t in np.arange(DT, begin + DT / 2, DT):
        advance(vehicles, t)
    for vehicle, (height, span) in zip(vehicles, climbs * 2, strict=True):
        vehicle.planner.climb(vehicle.t, at, height=height, yaw=0.0, span=span, landing=False)
    reached = [advance(vehicles, t) for t in begin + np.arange(DT, 20.0, DT)]
    share = np.array(reached) / [height for height, _ in climbs * 2] - 1.0
    for row in share.T:
        assert 0.07 < row.max() < 0.11
        assert 10.0 < DT * np.flatnonzero(np.abs(row) > 0.01)[-1] < 15.0  # until it settles


@pytest.mark.slow
@pytest.mark.parametrize(("step", "rise_ms", "overshoot"), [(0.3, 566.0, 0.09), (1.0, 733.0, 0.13)])
def test_steps_in_height(step, rise_ms, overshoot):
    wire = Wire().hovering()
    begin = wire.position[2]
    reached = (heights(wire, 3.0, lambda: wire.goal(0.0, 0.0, begin + step)) - begin) / step
    rise = 1e3 * DT * ((reached > 0.9).argmax() - (reached > 0.1).argmax())
    assert rise == pytest.approx(rise_ms, rel=0.04)
    assert reached.max() - 1.0 == pytest.approx(overshoot, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("wait", [1.0, 3.3])
def test_landing_from_the_overshoot_ends_on_the_floor(wait):
    wire = Wire()
    wire.takeoff(1.0, 2.5)
    wire.after(wait).land(1.1 / 0.22)
    lowest = []
    while wire.motors:
        lowest.append(wire.position[2])
        wire.wait(DT)
    assert lowest[-1] < 0.005
    assert np.diff(lowest).min() / DT > -0.5


@pytest.mark.slow
def test_thrust_in_hover_carries_the_weight():
    """29 g, and 39.3 g of a Brushless with guards, each with a deck, by the firmware's curves of thrust."""
    assert Wire().hovering().vehicle.vertical.thrust == pytest.approx(39300.0, rel=0.002)
    assert brushless().hovering().vehicle.vertical.thrust == pytest.approx(31750.0, rel=0.002)


@pytest.mark.parametrize("waited_s", [0.2, 3.0])
def test_raw_thrust_has_no_memory(waited_s):
    wire = Wire()
    wire.zero()
    wire.after(waited_s, lambda: wire.thrust(20000))
    assert wire.motors
    rise = wire.after(1.0, lambda: wire.thrust(45000)).position[2]
    spun_up_s = 0.03 * np.log((45000 - 20000) / (45000 - 39300))
    assert rise == pytest.approx(0.5 * 9.81 * (45000 / 39300 - 1.0) * (0.97 - spun_up_s) ** 2, rel=0.03)
    wire.after(1.0, lambda: wire.thrust(39300))
    height = wire.position[2] + 0.1 * wire.velocity[2]
    assert heights(wire, 6.0, lambda: wire.goal(0.0, 0.0, height))[-1] == pytest.approx(height, abs=0.05)
