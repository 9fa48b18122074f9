"""A drone that flies on board by positions from outside which mislead it: turned, stuck with noise, or late."""

from math import hypot, radians

import pytest

from agents.decision.lifecycle import AIRBORNE, DONE
from agents.safety.direction_check import DirectionCheck
from bridges.crazyflie.kind import CRAZYFLIE
from experiments.definition.experiment import LegTable
from tests.agents.safety.measured import DT, Flown
from twins.device import Faults

LINE = [LegTable(at_s=1.0, robot="F", plan={"kind": "line", "move_by": [0.5, 0.0], "speed": 0.3})]
TURNED, STUCK = "cut: it flies beside its commands", "cut: its measured height does not follow its climb"


def kicked(flown, speed):
    """A sudden change of its velocity along x [m/s]."""
    x, y, z = flown.vehicle.model.velocity
    flown.vehicle.model.velocity = x + speed, y, z
    return flown


@pytest.mark.parametrize("timeline", [[], LINE], ids=["hover", "line"])
@pytest.mark.parametrize("degrees", [60.0, -60.0, 90.0, 180.0])
def test_turned_frame_is_cut_early(degrees, timeline):
    flown = Flown(faults={"capture": "turned", "capture_by": radians(degrees)}, timeline=timeline).fly(12.0)
    assert flown.robot.lifecycle.phase == DONE
    assert [text.partition(": by")[0] for text in flown.incidents] == [TURNED]
    assert flown.aside < 0.5
    assert flown.log[-1][3:] == (0.0, False)


@pytest.mark.parametrize("hover", [0.2, 0.6, 1.2, 2.0])
def test_stuck_climb_is_cut_low(hover):
    flown = Flown(hover=hover, faults={"capture": "stuck", "capture_by": 0.0002}).climb().until(DONE).run(1.0)
    assert [text.rpartition(": ")[0] for text in flown.incidents] == [STUCK]
    assert flown.highest < 0.55
    assert flown.log[-1][3:] == (0.0, False)


@pytest.mark.parametrize("hover", [0.2, 0.6, 1.2, 2.0])
@pytest.mark.parametrize(("weight", "delay_s"), [(1.0, 0.1), (1.08, 0.0), (0.9, 0.0)])
def test_usual_climbs_raise_no_alarm(hover, weight, delay_s):
    flown = Flown(hover=hover, delay_s=delay_s)
    flown.vehicle.vertical._hover *= weight
    assert flown.climb().until(AIRBORNE).run(1.0).incidents == []
    assert flown.robot.lifecycle.phase == AIRBORNE


def test_noise_pushes_and_wind_are_not_turned():
    flown = Flown(sigma=0.01, timeline=LINE).fly(5.0)
    for speed in (0.5, -1.0):
        kicked(flown, speed).run(2.0)
    flown.vehicle.model.blow((0.3, 0.2))
    assert flown.run(4.0).incidents == []


@pytest.mark.parametrize("delay_s", [0.2, 0.3])
def test_positions_stamped_late_hold_then_land(delay_s):
    flown = Flown().fly(5.0)
    flown.delay_s = delay_s
    flown.run(6.0)
    assert [text.partition(":")[0] for text in flown.incidents] == ["hold", "land"]
    assert flown.log[-1][3:] == (0.0, False)
    assert flown.aside < 0.5


@pytest.mark.parametrize("late_s", [0.2, 0.3])
@pytest.mark.parametrize("from_s", [0.0, 6.0])
def test_lateness_before_the_stamp_ends_inside(late_s, from_s):
    faults = {"capture": "late", "capture_by": late_s, "capture_from_s": from_s}
    flown = Flown(hover=0.8, faults=faults).fly(25.0)
    assert flown.aside < 0.5
    assert flown.highest < 1.5
    assert flown.log[-1][3:] == (0.0, False)
    assert flown.incidents


def test_disobedient_position_cuts_far_outside_still():
    """A position that jumped does not: it may be another robot's."""
    for jump_m, cut in ((0.0, True), (3.0, False)):
        flown = Flown(hover=1.5).fly(1.0)
        robot, (x, y, z) = flown.robot, flown.vehicle.place
        robot.lifecycle.land("by a test")
        if jump_m:
            robot.believes(flown.t, (x + jump_m, y, z))
        robot._external.disbelieve()
        for tick in range(150):  # 3 m/s
            robot.believes(flown.t + DT * tick, (x + jump_m + 0.03 * tick, y, z))
        flown.faults = Faults(occluded_from_s=0.0)
        flown.run(0.2)
        assert (robot.lifecycle.reason == "it flies away") == cut


def test_direction_check_needs_motion_and_time():
    check = DirectionCheck(CRAZYFLIE)
    for tick in range(200):
        check.update(tick * DT, 0.5, 0.0, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    assert not check.turned, "it is held"
    for tick in range(200, 300):
        check.update(tick * DT, 0.5, 0.0, (0.0, 0.0, 0.5), (0.0, 1.0 * DT * (tick - 200), 0.0))
    assert check.turned
    assert check.angle == pytest.approx(radians(90.0), abs=0.7)
    check.forget()
    assert not check.turned
    assert hypot(check.x, check.y) == 0.0
