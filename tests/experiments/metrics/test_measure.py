"""Measures of a run, against motions with known integrals."""

import csv
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args, get_type_hints

import msgspec
import numpy as np
import pytest

from agents.network.messages import Event
from experiments.definition.experiment import AnchorTable, Shadow
from experiments.file.consistency.whole import judged_metrics
from experiments.metrics import metric, statistics
from experiments.metrics.measure import measure
from experiments.metrics.metric import DETAILS, FIGURES, OURS
from experiments.metrics.results import RobotMetrics
from experiments.metrics.shadow import agreement
from experiments.metrics.signals import Measurement, belief_errors, net_rotation
from experiments.report import export, figures, metrics_files, report, tables, typeset, verdict
from experiments.report.page import interval
from experiments.sweep import table
from tests.experiments.traces import STEP, at_origin, cut, pair, park, trace
from tools.commands import run
from tools.commands.explain import explain

T = np.arange(0.0, 20.0 + STEP / 2, STEP)
DECAY = pair(1.0 + np.exp(-T))


def unseen(known, *holes):
    """Trace with unknown positions: from, to [s] and row of each hole; no row: all."""
    place = known.true_position.copy()
    for begin, end, *row in holes:
        place[(known.time > begin) & (known.time < end), row[0] if row else slice(None)] = np.nan
    return replace(known, true_position=place)


def test_numbers_of_robots_are_rows_of_figures():
    kinds = {name: {*get_args(kind), kind} for name, kind in get_type_hints(RobotMetrics).items()}
    numbers = {name for name, kind in kinds.items() if kind & {int, float} and not kind & {dict[str, float | None]}}
    assert {*DETAILS} <= numbers <= {name for name, metric in FIGURES.items() if metric.per == "robot"}
    assert all(metric.label and metric.meaning.endswith(".") for metric in FIGURES.values())
    assert len({metric.head for metric in FIGURES.values()}) == len(FIGURES)


def test_a_new_figure_is_one_row(tmp_path, monkeypatch, capsys):
    row = metric._row(lambda m: m.trace.ticks * 2.0, "Twice", "Twice the ticks.", unit="s²", console=True, figure=True)
    for table_of_rows in ("OURS", "FIGURES"):
        monkeypatch.setattr(metric, table_of_rows, {**getattr(metric, table_of_rows), "twice": row})
    before, after = pair(1.0 + np.exp(-T)), pair(2.0 + np.exp(-T))
    cases = [measure(replace(before, case="a")), measure(replace(after, case="b"))]
    twice = 2.0 * float(before.ticks[1])
    assert (cases[0].robots[1].value("twice"), cases[0].mean["twice"]) == (twice, twice)
    metrics_files.write_csv(tmp_path / "metrics.csv", cases)
    with (tmp_path / "metrics.csv").open() as file:
        assert [float(line["twice"]) for line in csv.DictReader(file)][1:3] == [twice, twice]
    document = metrics_files.document("", 1, cases)
    assert document["cases"]["b"]["ratio"]["twice"] == 1.0
    struct = export.structure(before, cases[0])
    assert (struct["metrics"]["twice"].tolist()[1], struct["units"]["metrics"]["twice"]) == (twice, "s^2")
    listed = typeset.latex(report.result_tables(cases))
    assert "Twice [s$^2$]" in listed
    assert "twice" in table.relative_metrics()
    assert ("Twice", "Twice the ticks.") in tables.definitions(cases)
    assert explain("twice") == 0
    assert "metric: Twice [s²]" in capsys.readouterr().out
    line = run._case_line("b", [SimpleNamespace(metrics={each.case: each for each in cases})], document)
    assert f", Twice {interval(statistics.spread([twice]))} s², lost 0" in line
    assert "twice" in judged_metrics()


def test_integrals_of_a_decaying_error():
    measured = measure(DECAY)
    end = math.exp(-20.0)
    for robot in measured.robots:  # the leader listens to nobody: it has the error of the link that listens to it
        assert (robot.iae, robot.itae) == pytest.approx((1.0 - end, 1.0 - 21.0 * end), rel=1e-4)
        assert robot.rmse == pytest.approx(math.sqrt((1.0 - end**2) / 40.0), rel=1e-2)
    assert measured.robots[1].settle_s == pytest.approx(round(math.log(50.0) / STEP + 0.5) * STEP)  # 2 % of the largest
    assert (measured.leaders, measured.duration_s) == (("L",), pytest.approx(20.0))
    what = at_origin(dict.fromkeys("ABC", "tello"), {"A > B": 1.0, "B - C": 1.0})
    place = np.array([[(0.0, 0.0, 0.0), (1.25, 0.0, 0.0), (0.0, 3.0, 0.0)]] * 2)
    gap = math.hypot(1.25, 3.0) - 1.0  # errors sum over links that a robot receives
    assert Measurement(trace(what, place)).robot_errors[0] == pytest.approx([0.25, 0.25 + gap, gap])


def test_acquired_when_the_one_second_mean_stays_inside():
    measured = measure(pair(1.0 + np.maximum(1.0 - 0.0625 * T, 0.0)))
    # a window of 50 samples lags 24.5 of them: 1 − 0.0625 (t − 0.49) = 0.05
    assert measured.robots[1].acquired_s == pytest.approx(15.69, abs=STEP)
    assert measured.acquired_s == (measured.robots[1].acquired_s,)
    for off, residual in ((0.06, 0.06), (0.08 * np.where(np.arange(len(T)) % 2, 1.0, -1.0), 0.08)):
        never = measure(pair(np.ones_like(T) + off))
        found = never.robots[1].acquired_s, never.mean["acquired_s"], never.robots[1].residual
        assert found == (None, None, pytest.approx(residual))


def test_belief_before_the_first_pose_is_no_error():
    known = pair(np.ones_like(T), sent={"L": np.arange(0.0, 20.0, 0.5)})
    late = replace(known, received=known.received.take(known.received.arrival >= 10.0))
    error, begun = belief_errors(late, late.plan.links), late.received.arrival.min()
    assert np.isnan(error[late.time < begun]).all()
    assert np.isfinite(error[late.time >= begun]).any()
    silent = measure(replace(known, received=known.received.take(known.received.arrival < 0.0)))
    assert (silent.mean["belief_rms"], silent.mean["belief_max"]) == (None, None)
    assert all(each.rms is None for each in silent.belief)


def test_each_phase_is_measured_from_its_leg():
    off = np.where((T >= 10.0) & (T < 13.0), 0.5, 0.0) + np.where(T < 1e-9, 0.04, 0.0)
    measured = measure(pair(1.0 + off, legs=[9.99, 10.0]))
    robot = measured.robots[1]
    assert (measured.starts_s, robot.acquired_s) == ((0.0, 9.99), 0.0)  # legs within one sample are one phase
    (phase,) = robot.phases
    assert phase.acquired_s == pytest.approx(3.9, abs=2 * STEP)  # nine tenths of the window must be inside
    assert robot.by_the_end == (phase.residual, "L") == (pytest.approx(0.0, abs=1e-9), "L")
    assert measure(pair(np.ones_like(T), legs=[0.0, 20.0, 30.0])).starts_s == (0.0,)  # at the start, after the end


def test_residual_is_worst_link_in_phases_last_second():
    what = at_origin(dict.fromkeys("ABC", "tello"), {"A > C": 1.0, "B > C": 1.0}, legs=[10.0])
    place = np.zeros((len(T), 3, 3))
    place[:, 0, 0] = np.select([T < 9.0, T < 10.0], [-3.0, -1.02], -1.3)
    place[:, 1, 0] = 1.1
    robot = measure(trace(what, place)).robots[2]
    assert (robot.residual, robot.worst, *robot.by_the_end) == (pytest.approx(0.1), "B", pytest.approx(0.3), "A")


@pytest.mark.parametrize(("rate", "drift"), [(0.5, -0.3), (-0.2, 0.1), (0.0, 0.3)])
def test_net_rotation_finds_the_rate_whatever_else_moves(rate, drift):
    shape = np.random.default_rng(1).normal(size=(5, 3))
    turn = np.array([[np.cos(rate * T), -np.sin(rate * T)], [np.sin(rate * T), np.cos(rate * T)]])
    place = np.tile(shape, (len(T), 1, 1))
    place[..., :2] = np.einsum("abt,nb->tna", turn, shape[:, :2])
    place += drift * T[:, None, None]
    assert net_rotation(place, T) == pytest.approx(rate, abs=1e-9)


def test_net_rotation_after_acquisition_counts_beyond_full_turn():
    angle = 2.0 * np.pi * np.arange(3) / 3 + 0.5 * T[:, None]
    place = np.zeros((len(T), 4, 3))
    place[:, 1:, 0], place[:, 1:, 1] = np.cos(angle), np.sin(angle)
    names = dict.fromkeys("LABC", "khepera4")
    what = at_origin(names, {"L > A": 1.0, "L > B": 1.0, "L > C": 1.0, "A - B": math.sqrt(3.0)})
    assert measure(trace(what, place)).rotation_rad_s == (pytest.approx(0.5),)
    wrong = at_origin(names, {"L > A": 2.0})
    assert measure(trace(wrong, place)).rotation_rad_s == (None,)  # nothing was formed that could turn


@pytest.fixture(scope="module")
def moving():
    """The leader moves at 0.1 m/s and sends its place once a second."""
    place = np.zeros((len(T), 2, 3))
    place[:, 0, 0] = 0.1 * T
    what = at_origin({"L": "turtlebot3", "F": "khepera4"}, {"L > F": 1.0})
    return trace(what, place, sent={"L": np.arange(0.0, 20.0, 1.0).tolist()})


def test_belief_error_of_pose_held_for_a_second(moving):
    belief = measure(moving).belief[0]
    rms, most = pytest.approx(0.1 / math.sqrt(3.0), rel=0.03), pytest.approx(0.1, abs=0.1 * STEP + 1e-9)
    assert (belief.receiver, belief.sender, belief.rms, belief.max) == ("F", "L", rms, most)
    order = np.arange(20)
    order[[4, 5]] = 5, 4  # the sixth pose arrives first, at the time of the fifth
    overtaken = msgspec.structs.replace(moving.received.take(order), arrival=moving.received.arrival)
    swapped = measure(replace(moving, received=overtaken)).belief[0]
    assert swapped.max == pytest.approx(0.1, abs=0.003)  # ahead by as much, and never two seconds old


def test_transmissions_rates_and_gaps(moving):
    measured = measure(moving)
    leader, other = measured.robots
    assert (measured.network_messages, measured.deliveries) == (20, 20)
    assert (leader.messages, leader.bytes, leader.receivers, leader.received) == (20, 2000, 1, 20)
    assert (leader.f_hz, leader.gap_min_s, leader.gap_median_s, leader.gap_max_s) == pytest.approx([1.0] * 4)
    assert (other.messages, other.gap_median_s) == (0, None)
    kept = moving.sent.take(np.arange(20) % 3 == 0)  # what the recorder lost is counted by sequence numbers
    leader = measure(replace(moving, sent=kept)).robots[0]
    assert (leader.messages, leader.recorded) == (19, 7)


@pytest.mark.parametrize(
    ("seq", "messages"),
    [
        ([*range(401, 451), *range(1, 61)], 110),  # began anew at 1
        ([*range(401, 451, 2), *range(1, 61, 2)], 108),  # and the recorder missed every second one
        ([*range(1, 10), 300_000_000, *range(10, 20)], 22),  # a forged number: two more fit into the time beside it
    ],
)
def test_transmissions_of_a_restarted_and_a_forging_robot(moving, seq, messages):
    rows, number = np.zeros(len(seq), dtype=np.intp), np.array(seq)
    time, place = 0.02 * np.arange(len(seq)), np.zeros((len(seq), 3))
    sent = type(moving.sent)(rows, number, time, time, place, place, time, rows)
    leader = measure(replace(moving, sent=sent)).robots[0]
    assert (leader.messages, leader.recorded) == (messages, len(seq))


@pytest.mark.parametrize("anchored", [False, True])
def test_benchmark_cost_by_hand(anchored):
    known = pair(1.0 + np.exp(-T), sent={"F": [0.0, 1.0, 2.0, 10.0], "L": [0.5]})
    if anchored:  # at the place of the leader: the same once more
        formation = msgspec.structs.replace(known.plan.experiment.formation, anchors={"F": AnchorTable(distance=1.0)})
        known = replace(known, plan=known.plan.changed(formation=formation))
    # r² − 1 = x² + 2x with x = e⁻ᵗ, from 3 to 0: 2 % of it at x = √1.06 − 1, 3.5212 s; the last sample before
    settled = 3.52
    x = math.exp(-settled)
    iae, itae = 1.0 - x, 1.0 - (1.0 + settled) * x  # ∫ e⁻ᵗ dt and ∫ t e⁻ᵗ dt
    updates = 200 * 176 / 1000  # the goal changes at each of the 1000 samples
    expected = 0.02 * 3 + 0.1 * updates + 0.3 * settled + (1 + anchored) * (0.05 * iae + 0.005 * itae)
    assert measure(known).mean["j2"] == pytest.approx(expected, rel=1e-5)
    assert measure(pair(np.ones_like(T), sent={"F": [1.0]})).mean["j2"] == 0.0


def test_closest_approach_and_excursion():
    gap = 1.0 + 0.5 * np.cos(0.5 * T)  # closest at 2 π, farthest at the start
    outside, inside = measure(pair(gap + 1.0)), measure(pair(gap))
    assert (outside.mean["closest"], outside.excursion) == pytest.approx((1.5, 0.5), abs=1e-4)
    assert (outside.excursion_robot, inside.excursion, inside.excursion_robot) == ("F", 0.0, "")


def test_dead_robot_does_not_poison_the_others():
    whole = park(duration=20.0)
    row = {name: k for k, name in enumerate(whole.robots)}
    before, after = measure(whole), measure(unseen(whole, (10.0 - STEP / 2, 20.1, row["CF03"])))
    dead, neighbour = after.robots[row["CF03"]], after.robots[row["CF01"]]
    assert (after.died, dead.acquired_s) == (("CF03",), None)
    assert (dead.coverage, neighbour.coverage) == pytest.approx((0.5, 1.0 - 0.5 / 4.0), abs=0.01)
    assert after.robots[:4] == before.robots[:4]  # those that have no link with it
    assert after.mean["iae"] == pytest.approx(np.mean([robot.iae for robot in after.robots[1:6]]))
    assert None not in (after.acquired_s[0], after.rotation_rad_s[0])
    assert b"NaN" not in msgspec.json.encode(after)


def test_unseen_and_unlinked_robots_have_no_errors():
    measured = measure(pair(np.full_like(T, np.nan)))
    robot = measured.robots[1]
    assert (robot.iae, robot.rmse, robot.coverage, robot.known) == (None, None, 0.0, 0.0)
    assert measured.mean["closest"] is None
    alone = measure(trace(at_origin({"A": "tello"}, {}), np.zeros((100, 1, 3))))
    assert alone.leaders == ()  # nobody would be left
    assert (alone.mean["closest"], alone.mean["belief_rms"], alone.acquired_s) == (None, None, (None,))
    assert alone.robots[0].iae is None
    foreign = measure(replace(pair(np.ones_like(T)), foreign=np.array([0, 12])))
    assert [robot.foreign for robot in foreign.robots] == [0, 12]
    assert [each.mark for each in verdict.findings([foreign]) if "12 of F" in each.text] == ["bad"]
    lengths = (16, 14)  # a whole run may end one sample early
    assert [measure(pair(np.ones(k), step=1.0, planned=15.5)).interrupted for k in lengths] == [False, True]
    with pytest.raises(ValueError, match="fewer than two samples"):
        measure(pair(np.ones(1)))


def test_document_has_the_shape_for_scripts():
    first, second, short = (measure(known) for known in (park("a"), park("b", 0.01), cut(park("a"), 8.0)))
    found = metrics_files.document("runs/7", 4, [first, second])
    assert (found["run"], found["seed"], list(found["cases"])) == ("runs/7", 4, ["a", "b"])
    a, b = found["cases"].values()
    assert set(b) == {"robots", "mean", "ratio", "collisions", "network", "near_m"}
    assert set(b["mean"]) == set(b["ratio"]) == set(OURS)
    assert set(b["robots"]["TB01"]) == {name for name, metric in OURS.items() if metric.per == "robot"}
    followers = np.mean([b["robots"][name]["iae"] for name in b["robots"] if name != "TB01"])
    assert (b["mean"]["iae"], b["ratio"]["f_hz"]) == pytest.approx((followers, b["mean"]["f_hz"] / 50.0))
    assert (a["ratio"]["iae"], b["ratio"]["lost"]) == (1.0, None)  # the reference lost nothing
    assert msgspec.json.decode(msgspec.json.encode(found)) == found
    short = msgspec.structs.replace(short, spoiled=("robots failed",))
    ended = metrics_files.document("runs/7", 5, [short])
    assert (ended["cases"]["a"]["duration_s"], ended["cases"]["a"]["interrupted"]) == (8.0, True)
    flawed = statistics.across_seeds([metrics_files.document("runs/7", 4, [first]), ended])["flawed"]
    assert flawed == {"a": {5: ["robots failed", "interrupted after 8.0 s"]}}


def test_spread_over_seeds():
    documents = [
        {"seed": k, "cases": {"a": {group: dict.fromkeys(OURS, value) for group in ("mean", "ratio")}}}
        for k, value in enumerate([1.0, 2.0, None, 3.0])
    ]
    found = statistics.across_seeds(documents)
    assert (found["seeds"], "flawed" in found) == ([0, 1, 2, 3], False)
    half = pytest.approx(4.302653 / math.sqrt(3.0))
    assert found["cases"]["a"]["mean"]["iae"] == {"mean": 2.0, "std": 1.0, "ci95": half, "n": 3}
    few = [statistics.spread(values) for values in ([None], [5.0])]
    assert few == [statistics.Spread(None, None, None, 0), statistics.Spread(5.0, None, None, 1)]
    printed = {1: 12.7062, 2: 4.30265, 3: 3.18245, 4: 2.77645, 5: 2.57058, 9: 2.26216, 19: 2.09302, 99: 1.98422}
    assert [statistics.student_95(k) for k in printed] == pytest.approx([*printed.values()], rel=2e-6)


def test_ratios_pair_seeds_or_divide_by_the_mean():
    runs = [measure(park("a", seed=seed, duration=2.0)) for seed in (1, 2)]
    assert statistics.ratios(runs, runs[::-1], "iae") == [1.0, 1.0]
    first, second = (run.mean["iae"] for run in runs)
    assert statistics.ratios(runs, runs[:1], "iae") == [1.0, pytest.approx(second / first)]


def test_csv_has_a_row_per_robot_and_mean(tmp_path):
    measured = measure(park())
    metrics_files.write_csv(tmp_path / "metrics.csv", [measured])
    rows = list(csv.DictReader((tmp_path / "metrics.csv").read_text("utf-8").splitlines()))
    found = float(rows[2]["phase2_acquired_s"]), float(rows[-1]["iae"])
    assert found == (measured.robots[2].phases[0].acquired_s, measured.mean["iae"])
    assert [row["in_mean"] for row in rows] == ["0", *["1"] * 6, ""]


def test_time_without_a_network_is_nobodys_death():
    """A router was away for 2 s: all robots are unknown then, and come back one after the other."""
    measured, whole = measure(unseen(DECAY, (4.0, 6.0), (4.0, 6.4, 1))), measure(DECAY)
    assert measured.away_s == pytest.approx(2.0, abs=2 * STEP)
    follower = measured.robots[1]
    assert (measured.died, measured.acquired_s, follower.settle_s) == ((), whole.acquired_s, whole.robots[1].settle_s)
    assert (follower.coverage, *(robot.known for robot in measured.robots)) == (1.0, 1.0, 1.0)
    assert measured.mean["iae"] is not None
    assert any("away for 2.0 s" in finding.text for finding in verdict.interruptions([measured]))
    for gone in ([0, 1], [1]):  # and do not come back
        measured = measure(unseen(DECAY, *((4.0, 21.0, row) for row in gone)))
        assert (measured.away_s, measured.robots[1].known < 0.5) == (0.0, True)
        assert "F" in measured.died


VAIN = "it does not obey commands to move"
CAME_DOWN, TIPPED = "land: it came down by itself: its motors are off", "cut: it has tipped over: 80°"


@pytest.mark.parametrize(
    ("events", "failure"),
    [
        (["warn: a neighbour is lost: L"], ""),
        (["hold: its own position is lost: none", "over: its own position is lost, after"], ""),
        ([f"over: {VAIN}, after 2.00 s"], ""),
        ([f"warn: {VAIN}: 0.21 m commanded in vain", "its process ended"], f"{VAIN}: 0.21 m commanded in vain"),
        (["warn: its device does not answer: for 1.0 s"], "its device does not answer: for 1.0 s"),
        ([CAME_DOWN], CAME_DOWN),
        (
            ["land: it left the arena: 0.3 m outside", TIPPED],
            f"land: it left the arena: 0.3 m outside; at 4.0 s {TIPPED}",
        ),
        (["its process ended (exit code 1)"], "was lost: its process ended (exit code 1)"),
    ],
)
def test_robots_that_failed_their_part_are_named_first(events, failure):
    kinds = ["lost" if text.startswith("its process") else "hazard" for text in events]
    made = tuple(Event(3.0 + k, kind, "F", text) for k, (kind, text) in enumerate(zip(kinds, events, strict=True)))
    measured = measure(replace(DECAY, events=made))
    assert measured.failures == ((f"F at 3.0 s: {failure}",) if failure else ())
    first = verdict.findings([measured])[0]
    assert (first.mark == "bad") is bool(failure)
    assert first.text == f"Failed in only: F at 3.0 s: {failure}." or not failure


def test_what_failed_before_the_start_says_so():
    made = (Event(-0.4, "hazard", "F", CAME_DOWN),)
    assert measure(replace(DECAY, events=made)).failures == (f"F 0.4 s before the start: {CAME_DOWN}",)


LOST = "its own position is lost"
BLIND = f"hold: {LOST}: the last is 0.51 s old"


@pytest.mark.parametrize(
    ("events", "known", "failed"),
    [
        ({15.0: BLIND}, 0.75, "its position was known for 75% of the time only"),
        ({4.0: BLIND, 13.0: f"over: {LOST}, after 8.00 s"}, 0.6, "for 60% of the time only"),
        ({4.0: BLIND, 5.2: f"over: {LOST}, after 0.20 s"}, 0.99, ""),
        (
            {19.0: BLIND, 20.0: f"unresolved at the end: {LOST}, for 1.00 s"},
            0.95,
            f"F at 19.0 s: {LOST}: the last is 0.51 s old, until the end",
        ),
    ],
)
def test_body_that_repeats_an_old_position_has_none(events, known, failed):
    measured = measure(replace(DECAY, events=tuple(Event(at, "hazard", "F", text) for at, text in events.items())))
    robot = measured.robots[1]
    assert (robot.known, robot.coverage, measured.away_s) == pytest.approx((known, known, 0.0), abs=0.002)
    assert ("F" in measured.died, bool(measured.failures)) == (known < 0.95, bool(failed))
    assert failed in "".join(measured.failures)


def test_time_without_position_is_neither_inside_nor_outside():
    """The process of one robot stood still for 0.6 s, after it had acquired, or before it was inside."""
    measured = measure(unseen(DECAY, (6.0, 6.6, 1)))
    gap = "F from 6.0 to 6.6 s"
    assert (measured.acquired_s, measured.gaps) == (measure(DECAY).acquired_s, (gap,))
    assert [each.mark for each in verdict.findings([measured]) if gap in each.text] == ["fair"]
    early = measure(unseen(DECAY, (2.9, 3.7, 1))).acquired_s[0]
    assert early == pytest.approx(3.7, abs=0.1)  # inside for certain only when it is seen again
    blind = unseen(DECAY, (15.0, 21.0, 1))
    failed = measure(replace(blind, position=blind.true_position)).failures
    assert failed == ("F: its position was known for 75% of the time only",)


def shadowed(way, twin, *, yaw=0.0, twin_yaw=None, restart=5.0):
    """A robot with a twin beside it, and one without; the paths (T, 3) of robot and twin."""
    what = at_origin({"A": "crazyflie", "B": "crazyflie"}, {"A - B": 1.0})
    robots = {**what.robots, "A": msgspec.structs.replace(what.robots["A"], shadow=Shadow(restart_s=restart))}
    place = np.stack([way, np.full_like(way, 1.0)], axis=1)
    known = trace(msgspec.structs.replace(what, robots=robots), place)
    place, turn = (twin, np.full_like(twin, np.nan)), [yaw if twin_yaw is None else twin_yaw, np.nan]
    of_twin = {"shadow_position": np.stack(place, axis=1), "shadow_yaw": np.tile(turn, (len(T), 1))}
    return replace(known, yaw=np.full((len(T), 2), yaw), **of_twin)


def winding(t):
    return np.column_stack([np.sin(t), np.cos(0.7 * t), 0.5 + 0.1 * np.sin(0.3 * t)])


def test_a_constant_difference_is_bias_and_rmse():
    off = np.array([0.03, -0.04, 0.12])
    mine, none = agreement(shadowed(winding(T), winding(T) + off, yaw=math.pi / 2, twin_yaw=math.pi / 2 - 0.1))
    assert none is None
    assert (*mine.bias, mine.along, mine.across) == pytest.approx((0.03, -0.04, 0.12, -0.04, -0.03))
    assert (mine.rmse, mine.largest, mine.bias_yaw, mine.rmse_yaw) == pytest.approx((0.13, 0.13, -0.1, 0.1))
    assert (*mine.correlation, mine.correlation_speed) == pytest.approx([1.0] * 4)
    assert (mine.horizon_s, mine.known) == (5.0, 1.0)
    (mine, _) = agreement(shadowed(winding(T), winding(T), yaw=math.pi - 0.01, twin_yaw=-math.pi + 0.02))
    assert mine.bias_yaw == pytest.approx(0.03)  # the short way round


def test_a_lag_is_a_bias_along_the_way():
    heading, speed, lag = 0.6, 0.2, 0.15
    along = speed * np.array([math.cos(heading), math.sin(heading), 0.0])
    (mine, _) = agreement(shadowed(T[:, None] * along, (T - lag)[:, None] * along, yaw=heading))
    assert (mine.along, mine.across, mine.rmse) == pytest.approx((-speed * lag, 0.0, speed * lag))
    one = pytest.approx(1.0)
    assert (*mine.correlation, mine.correlation_speed) == (one, one, None, None)  # neither climbs, or is ever faster


def test_lag_behind_a_swing_shows_in_correlation():
    frequency, lag = math.pi, 0.1  # whole periods
    swing, late = (np.outer(0.2 * np.sin(frequency * at), [1.0, 0.0, 0.0]) for at in (T, T - lag))
    (mine, _) = agreement(shadowed(swing, late, restart=None))
    rmse = 0.2 * math.sqrt(2.0) * math.sin(0.5 * frequency * lag)
    assert (mine.correlation[0], mine.rmse) == pytest.approx((math.cos(frequency * lag), rmse), rel=1e-3)
    assert (mine.bias, mine.horizon_s) == (pytest.approx((0.0, 0.0, 0.0), abs=1e-4), None)


def test_reset_twin_has_its_horizons_error_and_speed():
    speed, forward = 0.1 + 0.05 * np.sin(T), [1.0, 0.0, 0.0]
    line = np.outer(np.concatenate([[0.0], np.cumsum(speed[:-1]) * STEP]), forward)
    ahead = np.outer(0.01 * np.mod(T + 1e-9, 5.0), forward)  # 1 cm/s too fast
    (mine, _) = agreement(shadowed(line, line + ahead))
    assert (mine.along, mine.rmse, mine.largest) == pytest.approx((0.025, 0.05 / math.sqrt(3.0), 0.05), rel=7e-3)
    assert mine.correlation_speed == pytest.approx(1.0)  # the jumps back are no speed of the twin's


def test_what_is_unknown_is_left_out():
    twin, way = winding(T) + np.array([0.01, 0.0, 0.0]), winding(T)
    twin[T < 5.0], way[T > 15.0] = np.nan, np.nan
    (mine, _) = agreement(shadowed(way, twin))
    assert (*mine.bias, mine.correlation_speed) == pytest.approx((0.01, 0.0, 0.0, 1.0))
    assert mine.known == pytest.approx(0.5, abs=2e-3)
    plain = trace(at_origin({"A": "crazyflie"}, {}), winding(T)[:, None])
    assert (agreement(shadowed(way, np.full_like(way, np.nan))), agreement(plain)) == ([None, None], [None])
    assert measure(plain).robots[0].shadow is None
    assert "shadows" not in figures.all_figures([], [plain])


def test_figure_has_a_row_for_each_shadowed_robot():
    known = shadowed(winding(T), winding(T) + np.array([0.02, 0.0, 0.0]))
    figure = figures.all_figures([], [known, replace(known, case="other")])["shadows"]
    assert len(figure.axes) == 4
    above, beside = figure.axes[:2]
    np.testing.assert_allclose(above.lines[1].get_xdata() - above.lines[0].get_xdata(), 0.02)
    assert [line.get_ydata().mean().round(9) for line in beside.lines] == [2.0, 0.0, 0.0]  # cm along, left, up
