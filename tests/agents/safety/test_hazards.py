"""Hazards: each cause has its outcome in its time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.limits import Limits
from agents.safety.hazards import Cause, Hazards, Outcome, failed, is_blind, rules
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from tests.cases import examples

DT = 0.01


def limits(**chosen):
    return Limits(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.5), **chosen)


class Bench:
    """State machine of one robot, as its decision drives it."""

    def __init__(self, kind=CRAZYFLIE, dt=DT, **chosen):
        self.dt, self.tick, self.acts = dt, 0, []
        self.hazards = Hazards(kind, limits(**chosen))

    def see(self, seconds, *causes, active=True, landing=False):
        present = sum(1 << cause for cause in causes)
        for _ in range(round(seconds / self.dt)):
            if present or self.hazards.under_way:
                t = self.tick * self.dt
                self.acts += self.hazards.update(
                    t, present, lambda cause: f"number {cause:d}", active=active, landing=landing
                )
            self.tick += 1
        return self

    @property
    def changes(self):
        """Outcomes, with the whole ticks at which they began."""
        return [(round(each.time / DT), each.outcome.name) for each in self.hazards.incidents]


WHILE_IT_LASTS = {  # of a drone: outcomes, and the ticks at which they begin, of causes
    ((0, "WARN"),): "MARGIN NEIGHBOUR BELOW BEHIND REFUSED",
    ((50, "WARN"),): "CLOCK UNREACHABLE",
    ((100, "WARN"),): "FOREIGN",
    ((200, "WARN"),): "CONDUCTOR HOVERING",
    ((0, "HOLD"),): "ORDERED SEPARATION ALONE CENTRE SUSPENDED UNSEEING OWNER",
    ((0, "HOLD"), (30, "LAND")): "POSITION",
    ((0, "HOLD"), (50, "LAND")): "SETPOINT",
    ((0, "HOLD"), (500, "LAND")): "LATE",
    ((20, "HOLD"), (100, "LAND")): "OVERSPEED",
    ((100, "HOLD"), (1000, "LAND")): "ROUTER",
    ((0, "LAND"),): "OUTSIDE TOUCHING FALLEN UNRESPONSIVE STRAYING",
    ((10, "LAND"),): "SINKING",
    ((100, "LAND"),): "BATTERY",
    ((1000, "LAND"),): "UNSTARTED",
    ((10, "CUT"),): "FAR_OUTSIDE TILT",
    ((2000, "CUT"),): "LANDING",
    ((0, "CUT"),): "STUCK",
    ((30, "CUT"),): "TURNED",
}
EXPECTED = {Cause[name]: list(changes) for changes, names in WHILE_IT_LASTS.items() for name in names.split()}


@pytest.mark.parametrize("cause", Cause, ids=lambda cause: cause.name.lower())
def test_outcomes_of_a_lasting_cause(cause):
    bench = Bench().see(25.0, cause)
    assert bench.changes == EXPECTED[cause]
    first = bench.hazards.incidents[0]
    assert first.text == f"{first.outcome.name.lower()}: {cause.rule.words}: number {cause:d}"
    last = EXPECTED[cause][-1][1]
    assert (bench.hazards.outcome().name, bench.hazards.held) == (last, cause.rule.place and last == "HOLD")
    assert [each.outcome.name for each in bench.acts] == [last][: last in ("LAND", "CUT")]


def test_choices_of_kind_and_experiment():
    for kind, chosen, cause, changes in (
        (KHEPERA4, {}, Cause.POSITION, [(0, "HOLD")]),
        (KHEPERA4, {}, Cause.UNRESPONSIVE, [(0, "WARN"), (200, "LAND")]),
        (KHEPERA4, {"hold_s": 10.0}, Cause.UNRESPONSIVE, [(0, "WARN")]),  # its world may pause
        (CRAZYFLIE, {"hold_s": 10.0}, Cause.UNRESPONSIVE, [(0, "WARN")]),
        (CRAZYFLIE, {"hold_s": 2.0}, Cause.POSITION, [(0, "HOLD"), (200, "LAND")]),
        (CRAZYFLIE, {"land_without_position_s": 1.0}, Cause.POSITION, [(0, "HOLD"), (100, "LAND")]),
        (CRAZYFLIE, {"lost_neighbour": "drop"}, Cause.NEIGHBOUR, [(0, "WARN")]),
        (CRAZYFLIE, {"lost_neighbour": "hold"}, Cause.NEIGHBOUR, [(0, "HOLD")]),
        (CRAZYFLIE, {"lost_neighbour": "land"}, Cause.NEIGHBOUR, [(0, "LAND")]),
        (CRAZYFLIE, {"lost_conductor": "land"}, Cause.CONDUCTOR, [(200, "LAND")]),
        (CRAZYFLIE, {"offline_s": 3.0, "neighbour_timeout_s": 0.5}, Cause.ROUTER, [(50, "HOLD"), (300, "LAND")]),
        (CRAZYFLIE, {"landing_s": 5.0}, Cause.LANDING, [(500, "CUT")]),
    ):
        assert Bench(kind, **chosen).see(12.0, cause).changes == changes


@pytest.mark.parametrize("cause", [cause for cause in Cause if EXPECTED[cause][0][1] == "HOLD"])
def test_hold_ends_after_a_quiet_second(cause):
    bench = Bench().see(EXPECTED[cause][0][0] * DT + 0.1, cause)
    clears = rules(limits())[cause].clears_s
    if cause.rule.place:
        for _ in range(round(clears / DT) - 1):
            assert bench.see(DT).hazards.held
    bench.see(2 * DT)
    assert not bench.hazards.held
    assert bench.hazards.worst().startswith("hold: ")
    bench.see(1.1 - clears)
    assert bench.hazards.incidents[-1].text.startswith(f"over: {cause.rule.words}, after ")
    assert (bench.hazards.worst(), bench.hazards.under_way, bench.acts) == ("", False, [])


def test_hazard_of_a_robot_that_ends():
    for absent_s, text in ((0.0, "unresolved at the end: {}, for 9.99 s"), (0.5, "over: {}, after 9.99 s")):
        bench = Bench().see(10.0, Cause.MARGIN).see(absent_s).see(5.0, Cause.MARGIN, active=False, landing=True)
        end = bench.hazards.incidents[-1]
        assert (end.outcome, end.text) == (Outcome.NONE, text.format("it is beyond a wall of the arena"))
        assert absent_s or end.time == pytest.approx(10.0)
        assert bench.hazards.worst() == ""


def test_cause_that_comes_and_goes():
    for cause, present_s, absent_s, changes in (
        (Cause.SEPARATION, 0.05, 0.3, [(0, "HOLD")]),  # reported once
        (Cause.SETPOINT, 0.02, 0.08, [(0, "HOLD"), (50, "LAND")]),
        (Cause.POSITION, 0.02, 0.08, [(0, "HOLD")]),
        (Cause.TILT, 0.05, 0.02, []),
    ):
        bench = Bench()
        for _ in range(20):
            assert bench.see(present_s, cause).hazards.under_way
            assert bench.see(absent_s).hazards.under_way == bool(changes)
        assert bench.changes == changes


def test_worst_hazard_is_shown_and_acted_on():
    bench = Bench()
    for causes, worst in (
        ([Cause.MARGIN], "warn: it is beyond a wall of the arena: number 2"),
        ([Cause.SEPARATION, Cause.MARGIN], "hold: minimum separation: number 5"),
        ([Cause.TILT, Cause.MARGIN], "cut: it has tipped over: number 8"),
    ):
        assert bench.see(0.15, *causes).hazards.worst() == worst
    assert [each.outcome for each in bench.acts] == [Outcome.CUT]
    several = Bench().see(0.09, Cause.TILT).see(DT * 2, Cause.TILT, Cause.OUTSIDE, Cause.STRAYING)
    assert [each.cause for each in several.acts] == [Cause.OUTSIDE, Cause.STRAYING, Cause.TILT]  # the hardest last


def test_hazards_on_the_ground_and_while_landing():
    bench = Bench().see(5.0, *Cause, active=False)
    assert (bench.hazards.incidents, bench.hazards.under_way) == ([], False)
    bench.see(30.0, *Cause, active=False, landing=True)
    warned = {Cause.BELOW, Cause.UNREACHABLE, Cause.HOVERING}
    cut = {Cause.FAR_OUTSIDE, Cause.TILT, Cause.LANDING}
    assert {each.cause for each in bench.hazards.incidents} == warned | cut | {Cause.OWNER}
    assert {each.outcome for each in bench.hazards.incidents if each.cause in cut} == {Outcome.CUT}


@examples(60)
@given(
    st.lists(st.tuples(st.sets(st.sampled_from(Cause)), st.integers(1, 60), st.booleans())),
    st.sampled_from(["drop", "hold", "land"]),
    st.sampled_from([CRAZYFLIE, KHEPERA4]),
)
def test_outcomes_only_become_harder(story, lost, kind):
    bench, hardest = Bench(kind, dt=0.05, lost_neighbour=lost), Outcome.NONE
    for causes, ticks, active in story:
        bench.see(ticks * bench.dt, *causes, active=active, landing=not active)
        now = bench.hazards.outcome()
        assert now >= hardest or hardest < Outcome.LAND
        hardest = max(hardest, now)
        assert (bench.hazards.worst() == "") == (now == Outcome.NONE)
    assert bool(bench.acts) == (hardest >= Outcome.LAND)
    assert bench.see(2.0).hazards.outcome() in (Outcome.NONE, Outcome.LAND, Outcome.CUT)


def test_incidents_of_robots_that_fail():
    for text, fails, blind in (
        ("land: it left the arena: 0.30 m outside", True, False),
        ("warn: it does not obey commands to move: 1 m commanded in vain", True, False),
        ("warn: a neighbour is lost: B", False, False),
        ("hold: its own position is lost: none", False, True),
        ("unresolved at the end: its own position is lost, for 2.00 s", True, True),
    ):
        assert (failed(text), is_blind(text)) == (fails, blind)
