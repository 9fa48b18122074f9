"""Hazards: each cause has its outcome in its time, and whatever happens a robot ends up stopped or landed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body.limits import Limits, Safety
from agents.decision.lifecycle import AIRBORNE, DONE, LANDING, READY, RUNNING
from agents.safety.detection import tilt_angle, tilted
from agents.safety.hazards import RULES, Cause, Hazards, Observation, Outcome, rules
from agents.safety.landing import PATIENCE_S
from agents.safety.situation import LATE_SHARE, ProcessHealth
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import drone, pair, triangle
from tests.agents.swarm import Swarm
from tests.agents.things import poses

LIMITS = Limits(np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.5]))
DT = 0.01
ALL = np.ones(2, dtype=bool)
NONE = ~ALL


class Bench:
    """A state machine of a drone and a ground robot, and what it said."""

    def __init__(self, dt=DT, **chosen):
        self.dt = dt
        limits = Limits(LIMITS.low, LIMITS.high, **chosen)
        self.hazards = Hazards(np.array([True, False]), limits)
        self.tick = 0
        self.acts = []

    @property
    def t(self):
        return self.tick * self.dt

    def see(self, seconds, *causes, rows=ALL, active=ALL, landing=NONE):
        for _ in range(round(seconds / self.dt)):
            seen = [Observation(cause, rows, lambda row: f"number {row}") for cause in causes]
            self.acts += self.hazards.update(self.t, seen, active, landing)
            self.tick += 1
        return self

    def changes(self, row=0):
        """When which outcome began, in whole ticks."""
        return [(round(each.time / DT), each.outcome.name) for each in self.hazards.incidents if each.row == row]


EXPECTED = {  # of a drone: outcomes, and the ticks at which they begin while the cause lasts
    Cause.ORDERED: [(0, "HOLD")],
    Cause.POSITION: [(0, "HOLD"), (30, "LAND")],
    Cause.MARGIN: [(0, "WARN")],
    Cause.OUTSIDE: [(0, "LAND")],
    Cause.FAR_OUTSIDE: [(10, "CUT")],
    Cause.SEPARATION: [(0, "HOLD")],
    Cause.TOUCHING: [(0, "LAND")],
    Cause.OVERSPEED: [(20, "HOLD"), (100, "LAND")],
    Cause.TILT: [(10, "CUT")],
    Cause.NEIGHBOUR: [(0, "WARN")],
    Cause.ALONE: [(0, "HOLD")],
    Cause.CENTRE: [(0, "HOLD")],
    Cause.BATTERY: [(100, "LAND")],
    Cause.ROUTER: [(100, "HOLD"), (1000, "LAND")],
    Cause.CONDUCTOR: [(200, "WARN")],
    Cause.FALLEN: [(0, "LAND")],
    Cause.SETPOINT: [(0, "HOLD"), (50, "LAND")],
    Cause.LATE: [(0, "HOLD"), (500, "LAND")],
    Cause.LANDING: [(2000, "CUT")],
    Cause.BELOW: [(0, "WARN")],
    Cause.SINKING: [(10, "LAND")],
    Cause.CLOCK: [(50, "WARN")],
    Cause.BEHIND: [(0, "WARN")],
    Cause.STANDSTILL: [(0, "HOLD")],
    Cause.STILL: [(0, "WARN")],
    Cause.STRAYING: [(0, "LAND")],
    Cause.UNREACHABLE: [(50, "WARN")],
    Cause.HOVERING: [(200, "WARN")],
}


@pytest.fixture(scope="module")
def lasting():
    """Hazards of drones that each have another cause for 25 s, in the order of the causes."""
    rows = np.eye(len(Cause), dtype=bool)
    hazards = Hazards(np.ones(len(Cause), dtype=bool), Limits(LIMITS.low, LIMITS.high))
    seen = [Observation(cause, rows[cause], lambda row: f"number {row}") for cause in Cause]
    for tick in range(2500):
        hazards.update(tick * DT, seen, rows.any(axis=0), rows[0] & rows[1])
    return hazards


@pytest.mark.parametrize("cause", Cause, ids=lambda cause: cause.name.lower())
def test_each_cause_has_its_outcomes_in_its_time(cause, lasting):
    found = [each for each in lasting.incidents if each.row == cause]
    assert [(round(each.time / DT), each.outcome.name) for each in found] == EXPECTED[cause]
    assert found[0].text == f"{found[0].outcome.name.lower()}: {RULES[cause].words}: number {cause:d}"
    assert lasting.outcome(cause).name == EXPECTED[cause][-1][1]
    places = RULES[cause].place and EXPECTED[cause][-1][1] == "HOLD"
    assert lasting.held[cause] == places


def test_a_ground_robot_without_a_position_stands_for_ever():
    bench = Bench().see(20.0, Cause.POSITION)
    assert bench.changes(row=1) == [(0, "HOLD")]


def test_choices_of_an_experiment():
    for lost, outcome in (("drop", "WARN"), ("hold", "HOLD"), ("land", "LAND")):
        assert Bench(lost_neighbour=lost).see(0.1, Cause.NEIGHBOUR).changes() == [(0, outcome)]
    assert Bench(lost_conductor="land").see(3.0, Cause.CONDUCTOR).changes() == [(200, "LAND")]
    assert Bench(offline_s=3.0, link_silence_s=0.5).see(4.0, Cause.ROUTER).changes() == [(50, "HOLD"), (300, "LAND")]
    assert Bench(landing_s=5.0).see(6.0, Cause.LANDING).changes() == [(500, "CUT")]
    assert Bench(blind_s=np.array([1.0, 2.0])).see(3.0, Cause.POSITION).changes() == [(0, "HOLD"), (100, "LAND")]


@pytest.mark.parametrize("cause", [cause for cause in Cause if EXPECTED[cause][0][1] == "HOLD"])
def test_a_hold_ends_after_its_time_and_is_over_after_a_quiet_second(cause):
    before = EXPECTED[cause][0][0] * DT
    bench = Bench().see(before + 0.1, cause)
    clears = rules(LIMITS)[cause].clears_s
    if RULES[cause].place:
        for _ in range(round(clears / DT) - 1):
            bench.see(DT)
            assert bench.hazards.held.all()
    bench.see(2 * DT)
    assert not bench.hazards.held.any()
    assert bench.hazards.worst(0).startswith("hold: ")
    bench.see(1.1 - clears)
    assert bench.hazards.incidents[-1].text.startswith(f"over: {RULES[cause].words}, after ")
    assert bench.hazards.worst(0) == ""
    assert bench.acts == []


def test_what_lands_never_ends():
    bench = Bench().see(0.1, Cause.OUTSIDE).see(60.0)
    assert bench.changes() == [(0, "LAND")]
    assert bench.hazards.outcome(0) == Outcome.LAND
    assert [each.row for each in bench.acts] == [0, 1]


@pytest.mark.parametrize("absent_s", [0.0, 0.5])
def test_a_hazard_of_a_robot_that_ends_is_unresolved_if_its_cause_was_there_until_then(absent_s):
    bench = Bench().see(10.0, Cause.MARGIN).see(absent_s).see(5.0, Cause.MARGIN, active=NONE, landing=ALL)
    *_, end = [each for each in bench.hazards.incidents if each.row == 0]
    assert end.outcome == Outcome.NONE
    if absent_s:
        assert end.text == "over: it is beyond a wall of the arena, after 9.99 s"
    else:
        assert end.text == "unresolved at the end: it is beyond a wall of the arena, for 9.99 s"
        assert end.time == pytest.approx(10.0)
    assert bench.hazards.worst(0) == ""


def test_what_flickers_is_told_once():
    bench = Bench()
    for _ in range(20):
        bench.see(0.05, Cause.SEPARATION).see(0.3)
    assert bench.changes() == [(0, "HOLD")]


def test_setpoints_that_are_wrong_again_and_again_land_positions_that_come_back_do_not():
    wild, blind = Bench(), Bench()
    for _ in range(10):
        wild.see(0.02, Cause.SETPOINT).see(0.08)
        blind.see(0.02, Cause.POSITION).see(0.08)
    assert wild.changes()[-1] == (50, "LAND")
    assert blind.changes() == [(0, "HOLD")]


def test_the_worst_is_shown_and_acted_on():
    bench = Bench().see(0.1, Cause.MARGIN)
    assert bench.hazards.worst(0) == "warn: it is beyond a wall of the arena: number 0"
    bench.see(0.1, Cause.SEPARATION, Cause.MARGIN)
    assert bench.hazards.worst(0) == "hold: minimum separation: number 0"
    bench.see(0.2, Cause.TILT, Cause.MARGIN)
    assert bench.hazards.worst(0) == "cut: it has tipped over: number 0"
    assert [each.outcome for each in bench.acts] == [Outcome.CUT] * 2


def test_who_is_on_the_ground_has_no_hazards_and_who_lands_only_those_of_landing():
    bench = Bench().see(5.0, *Cause, active=NONE)
    assert bench.hazards.incidents == []
    bench.see(30.0, *Cause, active=NONE, landing=ALL)
    assert {each.cause for each in bench.hazards.incidents} == {
        Cause.FAR_OUTSIDE,
        Cause.TILT,
        Cause.LANDING,
        Cause.BELOW,
        Cause.UNREACHABLE,
        Cause.HOVERING,
    }
    warned = {Cause.BELOW, Cause.UNREACHABLE, Cause.HOVERING}
    cut = {each.outcome for each in bench.hazards.incidents if each.cause not in warned}
    assert cut == {Outcome.CUT}


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.sets(st.sampled_from(Cause)), st.integers(1, 60), st.sampled_from(["both", "0", "1"]))),
    st.sampled_from(["drop", "hold", "land"]),
)
def test_outcomes_only_become_harder_while_a_cause_lasts(story, lost):
    bench = Bench(dt=0.05, lost_neighbour=lost)
    hardest = np.zeros(2, dtype=int)
    for causes, ticks, who in story:
        rows = {"both": ALL, "0": np.array([True, False]), "1": np.array([False, True])}[who]
        bench.see(ticks * bench.dt, *causes, rows=rows)
        for row in range(2):
            now = bench.hazards.outcome(row)
            if hardest[row] >= Outcome.LAND:
                assert now >= hardest[row]
            hardest[row] = max(hardest[row], now)
            assert (bench.hazards.worst(row) == "") == (now == Outcome.NONE)
    ended = [(each.row, each.cause) for each in bench.acts if each.outcome >= Outcome.LAND]
    assert {row for row, _ in ended} == set(np.flatnonzero(hardest >= Outcome.LAND).tolist())
    bench.see(2.0)
    assert all(bench.hazards.outcome(row) in (Outcome.NONE, Outcome.LAND, Outcome.CUT) for row in range(2))


# ---------------------------------------------------------------- causes, as robots see them


def happened(swarm):
    """Texts of hazards, by robot."""
    return {
        name: [each.text for each in group.agent.hazards.incidents if each.row == row]
        for name, (group, row) in swarm.where.items()
    }


def spoiled(swarm, **values):
    """From now on the bodies of the first group say this."""
    group = swarm.groups[0]

    def spoil(t, state):
        for name, value in values.items():
            was = getattr(state, name)
            if isinstance(was, tuple):
                setattr(state, name, value)
            elif was is None:
                setattr(state, name, np.tile(np.asarray(value, dtype=float), (len(state.yaw), 1)))
            else:
                was = was.copy()
                was[:] = value
                setattr(state, name, was)
        return state

    group.spoil = spoil


def leant(angle):
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]


UNSAFE = {
    "tipped": ({"attitude": leant(1.3)}, "cut: it has tipped over: it leans 74° (limit 69°)", DONE, 12),
    "level enough": ({"attitude": leant(1.1)}, None, RUNNING, 300),
    "unknown": ({"attitude": [np.nan] * 4}, None, RUNNING, 300),
    "empty": ({"battery": 0.09}, "land: its battery is low: 9% (limit 10%)", LANDING, 102),
    "no gauge": ({"battery": np.nan}, None, RUNNING, 300),
    "too fast": ({"velocity": [0.0, 4.4, 0.0]}, "hold: it moves faster than it can: 4.40 m/s", LANDING, 102),
    "fast": ({"velocity": [0.0, 4.2, 0.0]}, None, RUNNING, 300),
    "outside": ({"position": [2.3, 0.0, 0.5]}, "land: it left the arena: 0.30 m outside (limit 0.25 m)", LANDING, 2),
    "flown": ({"position": [2.8, 0.0, 0.5]}, "cut: it flies away: 0.80 m outside (limit 0.75 m)", DONE, 13),
    "beyond": ({"position": [2.1, 0.0, 0.5]}, "warn: it is beyond a wall of the arena: 0.10 m outside", RUNNING, 50),
    "sinks": (
        {"position": [0.0, 0.0, 0.3], "velocity": [0.0, 0.0, -0.2]},
        "land: it comes down by itself: 0.20 m below its goal, and sinks at 0.20 m/s",
        LANDING,
        13,
    ),
    "low": ({"position": [0.0, 0.0, 0.3], "velocity": [0.0, 0.0, -0.1]}, None, RUNNING, 150),
    "dips": ({"position": [0.0, 0.0, 0.4], "velocity": [0.0, 0.0, -0.2]}, None, RUNNING, 300),
    "down": ({"flying": False}, "land: it came down by itself: its motors are off", LANDING, 2),
}


@pytest.mark.parametrize("what", UNSAFE)
def test_a_drone_that(what):
    values, text, phase, ticks = UNSAFE[what]
    swarm = drone().running().run(0.3)
    swarm.agent("F").resume(0)  # it is put there: no jump
    spoiled(swarm, **values)
    swarm.run(0.01)
    assert swarm.phase("F") in (RUNNING, LANDING, phase)
    for _ in range(ticks - 1):
        swarm.step()
        if swarm.phase("F") >= phase > RUNNING:
            break
    assert swarm.phase("F") == phase
    told = happened(swarm)["F"]
    assert any(each.startswith(text) for each in told) if text else told == []


def test_wheels_whose_position_is_old_know_no_error():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.3)
    assert np.isfinite(swarm.agent("A").error).all()
    spoiled(swarm, time=swarm.t)
    swarm.run(0.4)
    assert np.isfinite(swarm.agent("A").error).all()
    swarm.run(0.3)
    assert np.isnan(swarm.agent("A").error).all()
    assert np.isfinite(swarm.agent("B").error).all()


def jumped(swarm, name, at, until, off=1.0):
    """The measured position of a robot is `off` [m] from `at` [s] on, before `until`."""
    group = next(group for group in swarm.groups if name in group.names)

    def spoil(t, state):
        if at <= t < until:
            state.position[group.names.index(name), 1] += off
        return state

    group.spoil = spoil


@pytest.mark.parametrize(("lasts_s", "phase"), [(0.01, RUNNING), (0.25, RUNNING), (0.5, LANDING)])
def test_a_drone_whose_position_jumps_lands_unless_it_is_back_at_once(lasts_s, phase):
    swarm = drone().running().run(0.3)
    place = swarm.row("F", "truth")
    jumped(swarm, "F", swarm.t, swarm.t + lasts_s)
    swarm.run(2.0)
    assert swarm.phase("F") >= phase
    assert swarm.phase("F") == RUNNING or phase == LANDING
    first = happened(swarm)["F"][0]
    assert first.startswith("hold: its own position is lost: it jumped by 1.0")
    assert np.linalg.norm((swarm.row("F", "truth") - place)[:2]) < 0.1


@pytest.mark.parametrize("begins", ["climbing", "running", "landing"])
def test_a_position_far_away_that_was_refused_cuts_no_motors(begins):
    swarm = drone()
    if begins == "climbing":
        swarm.run(0.1)
        while swarm.row("F", "truth")[2] < 0.2:
            swarm.conduct()
            swarm.step()
    else:
        swarm.running().run(0.3)
    if begins == "landing":
        swarm.agent("F").lifecycle.land(0, "by a test")
        swarm.run(0.2)
    jumped(swarm, "F", swarm.t, np.inf, off=1e5)
    while swarm.phase("F") != DONE:
        swarm.step()
        assert np.isnan(swarm.agent("F").state.position[0]).all()
    assert swarm.row("F", "truth")[2] < 0.05  # it has landed
    assert not any("flies away" in text for text in happened(swarm)["F"])


@pytest.mark.slow
def test_wheels_whose_position_jumps_stand_and_lead_nobody_astray_until_they_are_ordered_to_start():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(10.0)
    before = [swarm.row(name, "truth") for name in ("A", "B")]
    jumped(swarm, "A", swarm.t, np.inf)
    swarm.run(20.0)
    after = [swarm.row(name, "truth") for name in ("A", "B")]
    assert np.abs(np.array(after) - before).max() < 0.01
    assert happened(swarm)["A"] == ["hold: its own position is lost: it jumped by 1.00 m"]
    assert happened(swarm)["B"] == []
    swarm.agent("A").resume(0)
    swarm.run(2.0)
    assert happened(swarm)["A"][-1].startswith("over: its own position is lost, after 19.9")
    assert swarm.row("A", "setpoint").any()  # it believes its position


def test_two_that_come_too_near_hold_and_go_on_when_one_is_taken_away():
    experiment = pair(formation=Formation(links={"A - B": 0.3}), safety=Safety(separation=0.5))
    swarm = Swarm(experiment, [["A"], ["B"]]).running().run(12.0)
    place = swarm.column("truth")
    apart = np.linalg.norm(place[:, 0] - place[:, 1], axis=1)
    assert apart[-1] > 0.45
    assert np.ptp(place[-200:], axis=0).max() < 1e-3  # they stand
    told = happened(swarm)
    assert told["A"][0].startswith("hold: minimum separation: 0.50 m from B (limit 0.5 m)")
    assert len(told["A"]) == len(told["B"]) == 1
    agent = swarm.agent("A")
    for k in range(80):  # B is somewhere else now
        agent.neighbours.receive(
            poses(np.array([0]), np.array([[1.5, 0.0, 0.0]]), np.zeros((1, 3)), *np.full((2, 1), 99.0 + k))
        )
        swarm.groups[0].by_speaker.clear()
        swarm.step()
    assert swarm.row("A", "setpoint").any()


def test_two_that_nearly_touch_land():
    experiment = pair(safety=Safety(separation=0.3))
    swarm = Swarm(experiment, [["A"], ["B"]]).running().run(0.5)
    here = swarm.row("A", "position") + np.array([0.14, 0.0, 0.0])
    swarm.agent("A").neighbours.receive(
        poses(np.array([0]), here[None], np.zeros((1, 3)), np.array([99.0]), np.array([99.0]))
    )
    swarm.step()
    swarm.step()
    assert swarm.phase("A") >= LANDING
    assert swarm.agent("A").lifecycle.reason == ["far too near to another robot"]
    assert swarm.phase("B") == RUNNING  # it knows better where it is itself


@pytest.mark.parametrize(
    ("choice", "phase", "moves"), [("drop", RUNNING, True), ("hold", RUNNING, False), ("land", LANDING, False)]
)
def test_a_neighbour_that_is_lost(choice, phase, moves):
    experiment = triangle(safety=Safety(lost_neighbour=choice))
    swarm = Swarm(experiment, [["A"], ["B"], ["C"]]).running().run(0.5)
    swarm.agent("A").neighbours.mark_lost(np.array([0]), swarm.t)
    swarm.groups[0].by_speaker.pop("B")
    swarm.run(1.0)
    assert happened(swarm)["A"] == []
    swarm.run(0.03)
    assert happened(swarm)["A"] == [f"{'warn' if choice == 'drop' else choice}: a neighbour is lost: B"]
    before = swarm.row("A", "truth")
    swarm.run(1.0)
    assert min(swarm.phase("A"), LANDING) == phase
    assert (np.linalg.norm(swarm.row("A", "truth") - before) > 0.01) == moves
    if choice == "hold":
        swarm.agent("A").neighbours.mark_alive(np.array([0]))
        swarm.run(1.2)
        assert happened(swarm)["A"][-1].startswith("over: a neighbour is lost, after ")


def test_without_a_router_it_holds_and_then_lands():
    swarm = drone(safety=Safety(offline_s=3.0)).running().run(0.2)
    swarm.agent("F").health.offline_since = swarm.t
    swarm.run(2.9)
    assert happened(swarm)["F"] == ["hold: no connection to a router: for 1.0 s"]
    assert swarm.phase("F") == RUNNING
    swarm.run(0.15)
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (LANDING, ["no connection to a router"])


@pytest.mark.parametrize(("choice", "phase"), [("finish", RUNNING), ("land", LANDING)])
def test_without_a_conductor(choice, phase):
    swarm = drone(safety=Safety(lost_conductor=choice)).running().run(0.2)
    swarm.agent("F").health.conductor_lost_since = swarm.t
    swarm.run(1.9)
    assert happened(swarm)["F"] == []
    swarm.run(0.2)
    assert swarm.phase("F") == phase
    assert "the conductor is gone: for 2.0 s" in happened(swarm)["F"][0]


def test_a_control_loop_that_hardly_runs_holds_and_then_lands():
    outside = ProcessHealth()
    for _ in range(500):
        outside.count_tick(4, DT)
    assert outside.missed_share == pytest.approx(0.8)  # 20 Hz is slow, not hopeless
    outside.count_tick(500, DT)  # 5 s of nothing
    assert outside.missed_share > LATE_SHARE
    for _ in range(20):
        outside.count_tick(0, DT)
    assert outside.missed_share < LATE_SHARE
    for _ in range(2000):
        outside.count_tick(0, DT)
    assert outside.missed_share == 0.0
    swarm = drone().running().run(0.2)
    agent = swarm.agent("F")
    for _ in range(30):
        agent.health.count_tick(30, DT)
        swarm.tick += 30
        swarm.step()
    assert swarm.phase("F") >= LANDING
    assert agent.lifecycle.reason == ["its control loop misses its ticks"]


def test_a_law_that_wants_nonsense_lands():
    swarm = drone().running().run(0.2)
    group = swarm.groups[0]
    group.agent.goal_computer.decide = lambda *_, **__: pytest.fail("not asked")  # the goal stays what it is
    group.agent._decide = lambda *_: group.agent.goal.__setitem__(slice(None), np.nan)
    swarm.run(1.0)
    assert happened(swarm)["F"][0] == "hold: what it wants is not a setpoint: not made of finite numbers"
    assert swarm.agent("F").lifecycle.reason == ["what it wants is not a setpoint"]
    assert swarm.phase("F") >= LANDING


def landing(**values):
    """A drone that is told to land after 0.2 s, with `landing_s` 2, and whose body says this."""
    swarm = drone(safety=Safety(landing_s=2.0)).running().run(0.2)
    swarm.agent("F").lifecycle.land(0, "ordered to land")
    spoiled(swarm, **values)
    return swarm


@pytest.mark.parametrize(
    "values",
    [{"flying": True}, {"flying": True, "position": np.nan}, {"flying": True, "velocity": [0.0, 0.0, 0.5]}],
    ids=["on the floor", "blind", "climbs"],
)
def test_a_landing_drone_that_does_no_good_is_cut(values):
    """Landings with motors that stay on, without a position, or that move and do not descend."""
    swarm = landing(**values, **({"position": [0.0, 0.0, 0.5]} if "velocity" in values else {}))
    swarm.run(1.9)
    assert swarm.phase("F") == LANDING
    swarm.run(5.0)
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (DONE, ["its landing takes too long"])


@pytest.mark.slow
def test_a_landing_drone_that_hovers_is_never_cut():
    swarm = landing(flying=True, position=[0.0, 0.0, 0.5], velocity=[0.0, 0.0, 0.0]).run(30.0)
    assert swarm.phase("F") == LANDING
    assert "warn: it is told to land and hovers: at 0.50 m" in happened(swarm)["F"]


@pytest.mark.slow
def test_a_landing_that_takes_long_is_given_its_time():
    swarm = landing(flying=True)
    group = swarm.groups[0]
    spoil, begin = group.spoil, swarm.t

    def sinks(t, state):
        state = spoil(t, state)
        state.position[:, 2] = 1.0 - 0.03 * (t - begin)
        state.velocity[:] = 0.0, 0.0, -0.03
        return state

    group.spoil = sinks
    swarm.run(30.0)
    assert swarm.phase("F") == LANDING
    assert not any("land" in text for text in happened(swarm)["F"])


def test_leaning_is_an_angle_to_the_vertical():
    attitude = np.array([leant(0.5), [math.cos(0.6), 0.0, 0.0, math.sin(0.6)], [0.0, 1.0, 0.0, 0.0], [np.nan] * 4])
    assert [round(tilt_angle(attitude, row), 6) for row in range(3)] == [0.5, 0.0, round(math.pi, 6)]
    assert tilted(attitude, 0.49).tolist() == [True, False, True, False]


# ---------------------------------------------------------------- whatever happens

number = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([np.nan, 0.0, 9.0, 1e9]))
SPOILT = st.fixed_dictionaries(
    {},
    optional={
        "position": st.tuples(number, number, number),
        "velocity": st.tuples(number, number, number),
        "yaw": number,
        "battery": st.one_of(st.floats(0.0, 1.0), st.just(np.nan)),
        "attitude": st.sampled_from([leant(a) for a in (0.0, 1.0, 2.0)] + [[np.nan] * 4]),
        "flying": st.booleans(),
    },
)
EVENTS = st.sampled_from(["lose", "find", "offline", "online", "unattended", "skip", "hold", "start", "nothing"])


def occur(agent, event, t):
    """Something happens around a decision."""
    outside = agent.health
    match event:
        case "lose":
            agent.neighbours.mark_lost(np.arange(2), t)
        case "find":
            agent.neighbours.mark_alive(np.arange(2))
        case "offline" | "online":
            outside.offline_since = t if event == "offline" else np.inf
        case "unattended":
            outside.conductor_lost_since = t
        case "skip":
            agent.skip_ticks(200)
        case "hold":
            agent.hold(0)
        case "start":
            agent.start(0, t)


@pytest.mark.slow
@settings(max_examples=10)
@given(
    st.lists(st.tuples(SPOILT, EVENTS, st.integers(1, 80)), max_size=8),
    st.sampled_from(["drop", "hold", "land"]),
    st.booleans(),
)
def test_whatever_happens_nobody_comes_up_again(story, lost, early):
    robots = {"F": Robot(kind="crazyflie", start=[0.1, 0.2], hover=0.5), "G": Robot(kind="khepera4", start=[0.9, 0.1])}
    safety = Safety(lost_neighbour=lost, separation=0.4, offline_s=2.0)
    swarm = Swarm(pair(robots=robots, formation=Formation(links={"F - G": 0.8}), safety=safety, duration_s=20.0))
    swarm.until(READY if early else RUNNING)
    (group,) = swarm.groups
    agent = group.agent
    if early:
        agent.lifecycle.takeoff(0), agent.lifecycle.takeoff(1)
    before, lands = agent.lifecycle.phase.copy(), swarm.t
    for values, event, ticks in story:
        spoiled(swarm, **values)
        occur(agent, event, swarm.t)
        for _ in range(ticks):
            swarm.step()
            phase, setpoint = agent.lifecycle.phase, group.actions.setpoint
            down = before >= LANDING
            lands = swarm.t if phase[0] < LANDING else lands
            assert (phase[down] >= before[down]).all()
            assert np.isnan(setpoint[0]).all() or np.isfinite(setpoint[0]).all()
            assert np.isfinite(setpoint[1]).all()
            for row in range(2):
                if agent.hazards.outcome(row) >= Outcome.LAND:
                    assert phase[row] >= LANDING
                    assert agent.lifecycle.reason[row]
            ended = (phase < AIRBORNE) | (phase >= LANDING)
            assert not setpoint[1].any() or not ended[1]
            aside = swarm.t <= lands + PATIENCE_S + DT  # who comes down beside a robot goes there at its height
            assert np.isnan(setpoint[0]).all() or not ended[0] or (phase[0] == LANDING and aside)
            before = phase.copy()
    spoiled(swarm, position=np.nan)  # and now nothing is known any more
    swarm.run(3.0)
    assert agent.lifecycle.phase[0] in (LANDING, DONE) or agent.lifecycle.phase[0] <= READY
    assert not group.actions.setpoint[1].any()
