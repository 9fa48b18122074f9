"""Hazards: each cause has its outcome in its time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body.limits import Limits
from agents.safety.hazards import Cause, Hazards, Observation, Outcome, rules

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
    Cause.FOREIGN: [(100, "WARN")],
    Cause.REFUSED: [(0, "WARN")],
    Cause.STANDSTILL: [(0, "HOLD")],
    Cause.STILL: [(0, "LAND")],
    Cause.STRAYING: [(0, "LAND")],
    Cause.UNREACHABLE: [(50, "WARN")],
    Cause.HOVERING: [(200, "WARN")],
    Cause.UNSEEING: [(0, "HOLD")],
    Cause.UNSTARTED: [(1000, "LAND")],
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
    assert found[0].text == f"{found[0].outcome.name.lower()}: {cause.rule.words}: number {cause:d}"
    assert lasting.outcome(cause).name == EXPECTED[cause][-1][1]
    places = cause.rule.place and EXPECTED[cause][-1][1] == "HOLD"
    assert lasting.held[cause] == places


def test_a_ground_robot_without_a_position_stands_for_ever():
    bench = Bench().see(20.0, Cause.POSITION)
    assert bench.changes(row=1) == [(0, "HOLD")]


def test_a_robot_that_does_not_move_lands_unless_its_world_may_be_paused():
    assert Bench().see(20.0, Cause.STILL).changes() == [(0, "LAND")]
    assert Bench().see(20.0, Cause.STILL).changes(row=1) == [(0, "WARN"), (200, "LAND")]
    in_world = Bench(hold_s=np.array([10.0, 10.0])).see(20.0, Cause.STILL)
    assert [in_world.changes(row) for row in (0, 1)] == [[(0, "WARN")]] * 2


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
    if cause.rule.place:
        for _ in range(round(clears / DT) - 1):
            bench.see(DT)
            assert bench.hazards.held.all()
    bench.see(2 * DT)
    assert not bench.hazards.held.any()
    assert bench.hazards.worst(0).startswith("hold: ")
    bench.see(1.1 - clears)
    assert bench.hazards.incidents[-1].text.startswith(f"over: {cause.rule.words}, after ")
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
