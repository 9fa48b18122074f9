"""Landings in whole runs: a drone goes aside, and says so."""

from math import dist

import pytest

from agents.decision.lifecycle import DONE, LANDING
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.safety.hazards import Cause
from agents.safety.landing import NEAR
from experiments.definition.experiment import Experiment, Formation, Leg, Robot
from tests.agents.few import pair
from tests.agents.swarm import Swarm


def test_run_ends_beside_a_robot_below():
    """The links put the drone over the robot on wheels; the process and the event are the real ones."""
    robots = {
        "G": Robot(kind="khepera4", start=[0.0, 0.0]),
        "F": Robot(kind="crazyflie", start=[0.3, 0.0], hover=0.8),
        "H": Robot(kind="crazyflie", start=[-0.4, 0.0], hover=0.8),
    }
    links = {"G > F": 0.8, "H > F": 0.4}
    swarm = Swarm(Experiment(title="over", duration_s=3.0, robots=robots, formation=Formation(links=links)))
    swarm.running()
    robot = swarm.robot("F")
    swarm.until(LANDING)
    waited = False
    while swarm.phase("F") != DONE:
        assert swarm.since < 15.0
        swarm.step()
        waited |= robot.landing.aside
    gap = dist(swarm.last("F", "truth")[:2], swarm.last("G", "truth")[:2])
    assert waited
    assert gap > 0.09
    told = [each.text for each in robot.hazards.incidents if each.cause == Cause.BELOW]
    assert told[0] == "warn: a robot is below it: G; it goes aside first"
    assert swarm.phase("G") == DONE


@pytest.mark.parametrize("trigger", ["send-on-delta", "predictive"])
def test_drone_lands_beside_robot_that_died_moving(trigger):
    robots = {"F": Robot(kind="crazyflie", start=[0.0, 0.0], hover=1.0), "K": Robot(kind="khepera4", start=[-0.4, 0.0])}
    leg = Leg(at_s=0.0, robot="K", plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2})
    swarm = Swarm(
        pair(
            robots=robots,
            formation=Formation(),
            trigger={"kind": trigger, "threshold": 0.01},
            avoidance={"kind": "barrier", "hears": "all"},
            timeline=[leg],
        )
    ).running()
    while swarm.last("K", "truth")[0] < -0.02:
        swarm.step()
    dead, robot = swarm.where["K"][0], swarm.robot("F")
    place = swarm.last("K", "truth")[:2]
    swarm.groups.remove(dead)
    swarm.names = ("F",)
    robot.neighbours.mark_lost(0, swarm.t)
    swarm.run(3.0)
    robot.lifecycle.land("ordered to land")
    swarm.until(DONE)
    assert dist(swarm.last("F", "truth")[:2], place) - CRAZYFLIE.radius - KHEPERA4.radius > NEAR
