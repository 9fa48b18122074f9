"""Where drones come down: not on robots that they know to be below, whatever the scene."""

from itertools import combinations

import numpy as np
import pytest

from agents.body.interface import BodyState
from agents.decision.lifecycle import DONE, LANDING, BodyCommands
from agents.decision.neighbours import NeighbourStates
from agents.safety.hazards import Cause
from agents.safety.landing import NEAR, PATIENCE_S, ROOM, Landing
from agents.safety.setpoint_filter import SetpointFilter
from agents.safety.situation import ProcessHealth, Situation
from experiments.definition.experiment import Arena, Experiment, Formation, Leg, Robot
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.agents.swarm import Swarm
from tests.agents.things import poses

DT = 0.01
SINKS = 0.4  # [m/s]
NOBODY = np.zeros(0, dtype=np.intp)
KINDS = ("khepera4", "khepera4", "turtlebot3", "crazyflie", "crazyflie", "tello")


class Bench:
    """Robots anywhere, of whom all hear all, or none; they go where they are sent, and sink when they land."""

    def __init__(self, kinds, position, *, linked=True, arena=(6.0, 6.0, 2.0)):
        starts = np.linspace(-2.5, 2.5, len(kinds))
        heights = [{} if kind in {"khepera4", "turtlebot3"} else {"hover": 0.8} for kind in kinds]
        robots = {
            f"R{row}": Robot(kind=kind, start=[starts[row], 2.0], **height)
            for row, (kind, height) in enumerate(zip(kinds, heights, strict=True))
        }
        links = {f"{a} - {b}": 1.0 for a, b in combinations(robots, 2)} if linked else {}
        experiment = Experiment(
            title="bench",
            duration_s=5.0,
            robots=robots,
            formation=Formation(links=links),
            arena=Arena(size=list(arena)),
        )
        self.assignment = assignment = Plan(experiment).assignment(tuple(robots))
        self.landing = Landing(assignment)
        self.hearing = NeighbourStates(assignment.links, None, 1.0)
        self.hearing.mark_alive(np.arange(len(assignment.links)))
        self.safety = SetpointFilter(assignment.kinds, assignment.limits)
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros_like(self.position)
        rows = len(kinds)
        self.flies = np.array([kind.flies for kind in assignment.kinds])
        self.radius = np.array([kind.radius for kind in assignment.kinds])
        self.height = np.array([kind.height for kind in assignment.kinds])
        self.phase = np.where(self.flies, LANDING, DONE)
        self.sinking = np.zeros(rows, dtype=bool)
        self.asked = self.flies.copy()
        self.late, self.lag, self.t, self.told_at = False, 0.0, 0.0, np.full(rows, np.nan)

    def step(self):
        every = np.arange(len(self.phase))
        links = self.assignment.links
        speaker = links.sender
        stamps = np.full(len(links), self.t)
        self.hearing.receive(
            poses(np.arange(len(links)), self.position[speaker], self.velocity[speaker], stamps, stamps)
        )
        state = BodyState(
            np.full(len(every), self.t - self.lag), self.position.copy(), self.velocity.copy(), np.zeros(len(every)),
            self.position, np.zeros(len(every)), np.ones(len(every)), self.flies & (self.phase != DONE),
        )  # fmt: skip
        where = self.safety.validate_poses(state.position, state.yaw, self.t - state.time)
        duties = BodyCommands(NOBODY, np.flatnonzero(self.asked), NOBODY) if self.asked.any() else None
        self.asked[:] = False
        health = ProcessHealth(missed_share=float(self.late))
        out = self.landing.filter_commands(Situation(self.t, state, where, self.hearing, health), duties, self.phase)
        if out is not None:
            self.sinking[out.land] = True
            self.told_at[out.land] = self.t
        way = np.where(self.landing.aside[:, None], self.landing.place - self.position, 0.0)
        wanted = np.clip(2.0 * way, -0.3, 0.3)
        wanted[self.sinking & (self.phase != DONE), 2] = -SINKS
        self.velocity += (wanted - self.velocity) * DT / 0.1
        self.position = self.position + DT * self.velocity
        down = self.sinking & (self.position[:, 2] <= 0.0)
        self.position[down, 2], self.velocity[down], self.phase[down] = 0.0, 0.0, DONE
        self.t += DT

    def until_down(self):
        while (self.phase != DONE).any():
            self.step()
            assert self.gap() > 0.0, f"at {self.t:.2f} s"
            assert self.t < 15.0

    def gap(self):
        """The least distance of two surfaces, of pairs that are beside each other."""
        least = np.inf
        for a, b in combinations(range(len(self.phase)), 2):
            low, high = (a, b) if self.position[a, 2] < self.position[b, 2] else (b, a)
            if self.position[high, 2] < self.position[low, 2] + self.height[low]:
                apart = np.hypot(*(self.position[a, :2] - self.position[b, :2]))
                least = min(least, apart - self.radius[a] - self.radius[b])
        return least


def above(**parts):
    return Bench(("khepera4", "crazyflie"), [[0.0, 0.0, 0.0], [0.05, 0.0, 0.8]], **parts)


def test_it_goes_aside_at_its_height_and_comes_down_there():
    bench = above()
    bench.step()
    assert bench.landing.aside.tolist() == [False, True]
    assert bench.landing.place[1, 2] == 0.8
    assert bench.landing.robot_below(1) == "R0; it goes aside first"
    bench.until_down()
    assert 0.3 < bench.told_at[1] < 2.0
    assert bench.gap() > NEAR
    assert np.hypot(*bench.position[1, :2]) < 0.4  # and not farther than it must


def test_with_nobody_below_it_lands_at_once():
    beside = Bench(("khepera4", "crazyflie"), [[0.0, 0.0, 0.0], [0.3, 0.0, 0.8]])
    higher = Bench(("crazyflie", "crazyflie"), [[0.0, 0.0, 1.2], [0.3, 0.0, 0.8]])
    for bench in beside, higher, above(linked=False):
        bench.step()
        assert not bench.landing.aside.any()
        assert (bench.told_at[bench.flies] == 0.0).all()


def test_who_does_not_know_where_it_is_lands_where_it_is():
    blind, late, outside, low, fallen, grounded = (above() for _ in range(6))
    low.position[1] = 0.2, 0.0, 0.15
    blind.lag = 1.0
    late.late = True
    outside.position[:, 0] += 3.05
    fallen.phase[1] = DONE
    grounded.phase[:] = LANDING
    for bench in blind, late, outside, low, fallen:
        bench.step()
        assert not bench.landing.aside.any()
        assert bench.told_at[1] == 0.0
    grounded.asked[:] = True
    grounded.step()
    assert grounded.told_at[0] == 0.0


def test_on_its_way_it_can_be_told_to_stop_and_to_hurry():
    bench = above()
    bench.step()
    bench.phase[1] = DONE
    bench.step()
    assert not bench.landing.aside.any()
    assert np.isnan(bench.told_at[1])
    bench = above()
    bench.step()
    bench.lag = 1.0
    bench.step()
    assert bench.told_at[1] == pytest.approx(DT)
    bench = above()
    bench.step()
    bench.landing.land_in_place()
    bench.step()
    assert not bench.landing.aside.any()
    assert np.isnan(bench.told_at[1])  # something else has told the body


def test_it_does_not_look_for_ever():
    bench = above()
    while bench.t < PATIENCE_S + 0.5:
        bench.position[0, :2] = bench.position[1, :2]  # whoever is below goes along
        bench.step()
    assert bench.told_at[1] == pytest.approx(PATIENCE_S, abs=2 * DT)


def test_where_there_is_no_room_it_comes_down():
    grid = [[x, y, 0.0] for x in np.arange(-0.4, 0.41, 0.2) for y in np.arange(-0.4, 0.41, 0.2)]
    bench = Bench(("khepera4",) * len(grid) + ("crazyflie",), [*grid, [0.0, 0.0, 0.8]], arena=(1.0, 1.0, 2.0))
    bench.step()
    bench.step()
    assert bench.told_at[-1] <= DT


def test_who_is_gone_may_have_come_down_wherever_it_hung():
    bench = Bench(("crazyflie", "crazyflie"), [[0.0, 0.0, 1.5], [0.05, 0.0, 0.8]])
    bench.phase[0] = DONE
    bench.asked[0] = False
    bench.step()
    assert bench.told_at[1] == 0.0
    bench = Bench(("crazyflie", "crazyflie"), [[0.0, 0.0, 1.5], [0.05, 0.0, 0.8]])
    bench.phase[0] = DONE
    bench.asked[0] = False
    bench.hearing.receive(poses(np.arange(2), bench.position[[0, 1]], np.zeros((2, 3)), np.zeros(2), np.zeros(2)))
    bench.t = 1.0
    bench.hearing.mark_lost(np.arange(2), 0.5)
    bench.hearing.receive = lambda *_: None
    bench.step()
    assert bench.landing.aside[1]


@pytest.mark.parametrize("seed", range(12))
def test_whatever_the_scene_nobody_touches_anybody(seed):
    """All drones land at once over and beside robots on wheels; 12 x 10 scenes on 1.4 m x 1.4 m."""
    rng = np.random.default_rng(seed)
    made = 0
    while made < 10:
        place = np.column_stack(
            [rng.uniform(-0.7, 0.7, (6, 2)), np.where(np.arange(6) < 3, 0.0, rng.uniform(0.5, 1.2, 6))]
        )
        bench = Bench(KINDS, place)
        if bench.gap() < ROOM:
            continue
        made += 1
        bench.until_down()


def test_a_run_ends_beside_and_says_so():
    """The links put the drone over the robot on wheels; the process and the event are the real ones."""
    robots = {
        "G": Robot(kind="khepera4", start=[0.0, 0.0]),
        "F": Robot(kind="crazyflie", start=[0.3, 0.0], hover=0.8),
        "H": Robot(kind="crazyflie", start=[-0.4, 0.0], hover=0.8),
    }
    links = {"G > F": 0.8, "H > F": 0.4}
    swarm = Swarm(Experiment(title="over", duration_s=3.0, robots=robots, formation=Formation(links=links)))
    swarm.running()
    agent = swarm.agent("F")
    row = swarm.where["F"][1]
    swarm.until(LANDING)
    waited = False
    while swarm.phase("F") != DONE:
        assert swarm.since < 15.0
        swarm.step()
        waited |= bool(agent.landing.aside[row])
    gap = np.hypot(*(swarm.row("F", "truth")[:2] - swarm.row("G", "truth")[:2]))
    assert waited
    assert gap > 0.09
    told = [each.text for each in agent.hazards.incidents if each.cause == Cause.BELOW]
    assert told[0] == "warn: a robot is below it: G; it goes aside first"
    assert swarm.phase("G") == DONE


@pytest.mark.parametrize("trigger", ["send-on-delta", "predictive"])
def test_drone_lands_beside_robot_that_died_moving(trigger):
    robots = {
        "F": Robot(kind="crazyflie", start=[0.0, 0.0], hover=1.0),
        "K": Robot(kind="khepera4", start=[-0.4, 0.0]),
    }
    leg = Leg(at_s=0.0, robot="K", plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2})
    swarm = Swarm(
        pair(
            robots=robots,
            formation=Formation(),
            trigger={"kind": trigger, "threshold": 0.01},
            avoidance={"kind": "barrier", "hears": "all"},
            timeline=[leg],
        ),
        [["F"], ["K"]],
    ).running()
    drone, dead = swarm.where["F"][0], swarm.where["K"][0]
    while dead.body.engine.position[0, 0] < -0.02:
        swarm.step()
    swarm.groups.remove(dead)
    swarm.names = ("F",)
    drone.agent.neighbours.mark_lost(drone.by_speaker["K"], swarm.t)
    swarm.run(3.0)
    drone.agent.lifecycle.land(0, "ordered to land")
    swarm.until(DONE)
    apart = np.hypot(*(drone.body.engine.position[0, :2] - dead.body.engine.position[0, :2]))
    radii = drone.assignment.kinds[0].radius + dead.assignment.kinds[0].radius
    assert apart - radii > NEAR
