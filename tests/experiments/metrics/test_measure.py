from __future__ import annotations

import csv
import dataclasses
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.network.messages import Event
from experiments.definition.experiment import AnchorTable
from experiments.metrics import measure, statistics
from experiments.metrics.metric import OURS
from experiments.metrics.results import CaseMetrics, RobotMetrics
from experiments.metrics.signals import belief_errors, formation_errors, net_rotation
from experiments.recording.trace import Trace
from experiments.report import metrics_files, verdict
from tests.experiments.traces import STEP, cut, experiment, pair, park, trace

T = np.arange(0.0, 20.0 + STEP / 2, STEP)


def follower(measured: CaseMetrics) -> RobotMetrics:
    return next(robot for robot in measured.robots if robot.robot == "F")


def test_integrals_of_a_decaying_error():
    measured = measure.measure(pair(1.0 + np.exp(-T)))
    end = math.exp(-20.0)
    for robot in measured.robots:  # the leader listens to nobody: it has the error of the link that listens to it
        assert robot.iae == pytest.approx(1.0 - end, rel=1e-4)
        assert robot.itae == pytest.approx(1.0 - 21.0 * end, rel=1e-4)
        assert robot.rmse == pytest.approx(math.sqrt((1.0 - end**2) / 40.0), rel=1e-2)
    assert measured.leaders == ("L",)
    assert measured.duration_s == pytest.approx(20.0)


def test_error_sums_over_links_that_a_robot_receives():
    what = experiment({"A": "tello", "B": "tello", "C": "tello"}, {"A > B": 1.0, "B - C": 1.0})
    place = np.zeros((2, 3, 3))
    place[:, 1, 0], place[:, 2, 1] = 1.25, 3.0
    gap = math.hypot(1.25, 3.0) - 1.0
    assert formation_errors(trace(what, place))[0] == pytest.approx([0.25, 0.25 + gap, gap])


def test_acquired_when_the_one_second_mean_stays_inside():
    measured = measure.measure(pair(1.0 + np.maximum(1.0 - 0.0625 * T, 0.0)))
    # a window of 50 samples lags 24.5 of them: 1 − 0.0625 (t − 0.49) = 0.05
    assert follower(measured).acquired_s == pytest.approx(15.69, abs=STEP)
    assert measured.acquired_s == (follower(measured).acquired_s,)


def test_foreign_poses_are_named_in_the_verdict():
    clean = pair(np.ones_like(T))
    assert not any("other sessions" in each.text for each in verdict.findings([measure.measure(clean)]))
    forged = np.zeros(len(clean.robots), dtype=np.intp)
    forged[clean.robots.index("F")] = 12
    measured = measure.measure(dataclasses.replace(clean, foreign=forged))
    assert {robot.robot: robot.foreign for robot in measured.robots} == {"F": 12, "L": 0}
    (found,) = [each for each in verdict.findings([measured]) if "other sessions" in each.text]
    assert found.mark == "bad"
    assert "12 of F" in found.text


def test_belief_before_the_first_pose_is_no_error():
    known = pair(np.ones_like(T), sent={"L": np.arange(0.0, 20.0, 0.5)})
    first = np.flatnonzero(known.received.arrival >= 10.0)
    late = dataclasses.replace(known, received=known.received.take(first))
    net = late.plan.links
    error = belief_errors(late, net)
    begun = late.received.arrival.min()
    assert np.isnan(error[late.time < begun]).all()
    assert np.isfinite(error[late.time >= begun]).any()
    silent = measure.measure(dataclasses.replace(known, received=known.received.take(first[:0])))
    assert silent.mean["belief_rms"] is None
    assert silent.mean["belief_max"] is None
    assert all(each.rms is None for each in silent.belief)


def test_never_acquired_is_none_also_in_the_mean():
    measured = measure.measure(pair(np.full_like(T, 1.06)))
    assert follower(measured).acquired_s is None
    assert measured.mean["acquired_s"] is None
    assert follower(measured).residual == pytest.approx(0.06)


def test_jitter_about_zero_does_not_hide_in_mean():
    measured = measure.measure(pair(1.0 + 0.08 * np.where(np.arange(len(T)) % 2, 1.0, -1.0)))
    assert follower(measured).acquired_s is None


def test_each_phase_is_measured_from_its_leg():
    off = np.where((T >= 10.0) & (T < 13.0), 0.5, 0.0) + np.where(T < 1e-9, 0.04, 0.0)
    measured = measure.measure(pair(1.0 + off, legs=[9.99, 10.0]))
    assert measured.starts_s == (0.0, 9.99)  # legs that begin within one sample are one phase
    robot = follower(measured)
    assert robot.acquired_s == 0.0
    assert len(robot.phases) == 1
    assert robot.phases[0].acquired_s == pytest.approx(3.9, abs=2 * STEP)  # nine tenths of the window must be inside
    assert robot.phases[0].residual == pytest.approx(0.0, abs=1e-9)
    assert robot.by_the_end == (robot.phases[0].residual, "L")


def test_legs_at_start_or_after_end_are_ignored():
    assert measure.measure(pair(np.ones_like(T), legs=[0.0, 20.0, 30.0])).starts_s == (0.0,)


def test_residual_is_worst_link_in_phases_last_second():
    what = experiment({"A": "tello", "B": "tello", "C": "tello"}, {"A > C": 1.0, "B > C": 1.0}, legs=[10.0])
    place = np.zeros((len(T), 3, 3))
    place[:, 0, 0] = np.where(T < 9.0, -3.0, np.where(T < 10.0, -1.02, -1.3))
    place[:, 1, 0] = 1.1
    robot = measure.measure(trace(what, place)).robots[2]
    assert (robot.residual, robot.worst) == (pytest.approx(0.1), "B")
    assert robot.by_the_end == (pytest.approx(0.3), "A")


@settings(max_examples=40)
@given(rate=st.floats(-0.5, 0.5), drift=st.floats(-0.3, 0.3), seed=st.integers(0, 1000))
def test_net_rotation_finds_the_rate_whatever_else_moves(rate: float, drift: float, seed: int):
    shape = np.random.default_rng(seed).normal(size=(5, 3))
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
    what = experiment(names, {"L > A": 1.0, "L > B": 1.0, "L > C": 1.0, "A - B": math.sqrt(3.0)})
    assert measure.measure(trace(what, place)).rotation_rad_s == (pytest.approx(0.5),)
    wrong = experiment(names, {"L > A": 2.0})
    assert measure.measure(trace(wrong, place)).rotation_rad_s == (None,)  # nothing was formed that could turn


def moving(**rest: object) -> Trace:
    """The speaker moves at 0.1 m/s and says so once a second."""
    place = np.zeros((len(T), 2, 3))
    place[:, 0, 0] = 0.1 * T
    what = experiment({"L": "turtlebot3", "F": "khepera4"}, {"L > F": 1.0})
    return trace(what, place, sent={"L": np.arange(0.0, 20.0, 1.0).tolist()}, **rest)


def test_belief_error_of_pose_held_for_a_second():
    belief = measure.measure(moving()).belief[0]
    assert (belief.receiver, belief.sender) == ("F", "L")
    assert belief.rms == pytest.approx(0.1 / math.sqrt(3.0), rel=0.03)
    assert belief.max == pytest.approx(0.1, abs=0.1 * STEP + 1e-9)


def test_an_overtaken_pose_is_not_believed():
    known = moving()
    order = np.arange(20)
    order[[4, 5]] = 5, 4  # the sixth pose arrives first, at the time of the fifth
    overtaken = msgspec.structs.replace(known.received.take(order), arrival=known.received.arrival)
    swapped = measure.measure(dataclasses.replace(known, received=overtaken)).belief[0]
    assert swapped.max == pytest.approx(0.1, abs=0.003)  # ahead by as much, and never two seconds old


def test_transmissions_rates_and_gaps():
    measured = measure.measure(moving())
    leader, other = measured.robots
    assert (leader.messages, leader.bytes, leader.receivers, leader.received) == (20, 2000, 1, 20)
    assert leader.f_hz == pytest.approx(1.0)
    assert (leader.gap_min_s, leader.gap_median_s, leader.gap_max_s) == pytest.approx((1.0, 1.0, 1.0))
    assert (other.messages, other.gap_median_s) == (0, None)


def test_recorder_losses_are_counted_by_sequence_numbers():
    known = moving()
    kept = known.sent.take(np.arange(20) % 3 == 0)
    leader = measure.measure(dataclasses.replace(known, sent=kept)).robots[0]
    assert (leader.messages, leader.recorded) == (19, 7)


@pytest.mark.parametrize(
    ("seq", "messages"),
    [
        ([*range(401, 451), *range(1, 61)], 110),  # began anew at 1
        ([*range(401, 451, 2), *range(1, 61, 2)], 108),  # and the recorder missed every second one
        ([*range(1, 10), 300_000_000, *range(10, 20)], 22),  # a forged number: two more fit into the time beside it
    ],
)
def test_transmissions_of_a_restarted_and_a_forging_robot(seq: list[int], messages: int):
    known = moving()
    time = 0.02 * np.arange(len(seq))
    place = np.zeros((len(seq), 3))
    row = np.zeros(len(seq), dtype=np.intp)
    sent = type(known.sent)(row, np.array(seq), time, time, place, place, time, row)
    leader = measure.measure(dataclasses.replace(known, sent=sent)).robots[0]
    assert (leader.messages, leader.recorded) == (messages, len(seq))


def test_settling_time_is_two_percent_of_largest_error():
    settle = round(math.log(50.0) / STEP + 0.5) * STEP
    assert measure.measure(pair(1.0 + np.exp(-T))).robots[1].settle_s == pytest.approx(settle)


@pytest.mark.parametrize("anchored", [False, True])
def test_benchmark_cost_by_hand(anchored: bool):
    known = pair(1.0 + np.exp(-T), sent={"F": [0.0, 1.0, 2.0, 10.0], "L": [0.5]})
    if anchored:  # at the place of the leader: the same once more
        formation = msgspec.structs.replace(known.plan.experiment.formation, anchors={"F": AnchorTable(distance=1.0)})
        known = dataclasses.replace(known, plan=known.plan.changed(formation=formation))
    # r² − 1 = x² + 2x with x = e⁻ᵗ, from 3 to 0: 2 % of it at x = √1.06 − 1, 3.5212 s; the last sample before
    settled = 3.52
    x = math.exp(-settled)
    iae, itae = 1.0 - x, 1.0 - (1.0 + settled) * x  # ∫ e⁻ᵗ dt and ∫ t e⁻ᵗ dt
    updates = 200 * 176 / 1000  # the goal changes at each of the 1000 samples
    expected = 0.02 * 3 + 0.1 * updates + 0.3 * settled + (1 + anchored) * (0.05 * iae + 0.005 * itae)
    assert measure.measure(known).mean["j2"] == pytest.approx(expected, rel=1e-5)


def test_benchmark_cost_without_deviation_is_zero():
    assert measure.measure(pair(np.ones_like(T), sent={"F": [1.0]})).mean["j2"] == 0.0


def test_closest_approach_and_excursion():
    gap = 1.0 + 0.5 * np.cos(0.5 * T)  # closest at 2 π, farthest at the start
    measured = measure.measure(pair(gap + 1.0))
    assert measured.mean["closest"] == pytest.approx(1.5, abs=1e-4)
    assert (measured.excursion, measured.excursion_robot) == (pytest.approx(0.5), "F")
    inside = measure.measure(pair(gap))
    assert (inside.excursion, inside.excursion_robot) == (0.0, "")


def test_dead_robot_does_not_poison_the_others():
    whole = park(duration=20.0)
    place = whole.true_position.copy()
    place[500:, whole.robots.index("CF03")] = np.nan
    before, after = measure.measure(whole), measure.measure(dataclasses.replace(whole, true_position=place))
    dead = after.robots[whole.robots.index("CF03")]
    assert after.died == ("CF03",)
    assert dead.acquired_s is None
    assert dead.coverage == pytest.approx(0.5, abs=0.01)
    for old, new in zip(before.robots[:4], after.robots[:4], strict=True):  # those that have no link with it
        assert new == old
    five = [robot.iae for robot in after.robots[1:6]]
    assert after.mean["iae"] == pytest.approx(np.mean(five))
    assert after.acquired_s[0] is not None
    assert after.rotation_rad_s[0] is not None
    neighbour = after.robots[whole.robots.index("CF01")]
    assert neighbour.coverage == pytest.approx(1.0 - 0.5 / 4.0, abs=0.01)
    assert msgspec.json.encode(after).find(b"NaN") == -1


def test_robot_never_seen_has_no_errors():
    known = pair(np.full_like(T, np.nan))
    robot = follower(measure.measure(known))
    assert (robot.iae, robot.rmse, robot.coverage, robot.known) == (None, None, 0.0, 0.0)
    assert measure.measure(known).mean["closest"] is None


def test_one_robot_without_links():
    known = trace(experiment({"A": "tello"}, {}), np.zeros((100, 1, 3)))
    measured = measure.measure(known)
    assert measured.leaders == ()  # nobody would be left
    assert (measured.mean["closest"], measured.mean["belief_rms"], measured.acquired_s) == (None, None, (None,))
    assert measured.robots[0].iae is None


def test_a_trace_without_time_is_refused():
    with pytest.raises(ValueError, match="fewer than two samples"):
        measure.measure(pair(np.ones(1)))


def test_document_has_the_shape_for_scripts():
    first, second = (measure.measure(park("a", seed=4)), measure.measure(park("b", 0.01, seed=4)))
    found = metrics_files.document("runs/7", 4, [first, second])
    assert (found["run"], found["seed"], list(found["cases"])) == ("runs/7", 4, ["a", "b"])
    b = found["cases"]["b"]
    assert set(b) == {"robots", "mean", "ratio", "collisions", "network", "near_m"}
    assert b["collisions"] == 0
    short = metrics_files.document("runs/7", 4, [measure.measure(cut(park("a", seed=4), 8.0))])["cases"]["a"]
    assert (short["duration_s"], short["interrupted"]) == (8.0, True)
    assert set(b["mean"]) == set(b["ratio"]) == set(OURS)
    assert set(b["robots"]["TB01"]) == {name for name, metric in OURS.items() if metric.per == "robot"}
    followers = [b["robots"][name]["iae"] for name in b["robots"] if name != "TB01"]
    assert b["mean"]["iae"] == pytest.approx(np.mean(followers))
    assert b["ratio"]["f_hz"] == pytest.approx(b["mean"]["f_hz"] / 50.0)
    assert found["cases"]["a"]["ratio"]["iae"] == 1.0
    assert b["ratio"]["lost"] is None  # the reference lost nothing
    assert msgspec.json.decode(msgspec.json.encode(found)) == found


@pytest.mark.slow
def test_interrupted_run_is_measured_by_its_own_length():
    measured = measure.measure(cut(park(), 8.0))
    whole = measure.measure(park())
    assert (measured.duration_s, measured.planned_s, measured.interrupted) == (8.0, 45.0, True)
    assert not whole.interrupted
    assert measured.died == ()
    assert measured.starts_s == (0.0,)
    robot = measured.robots[1]
    assert robot.messages == 400
    assert robot.f_hz == pytest.approx(50.0)
    assert robot.known == 1.0
    assert robot.iae < whole.robots[1].iae
    assert [index for index, value in measured.mean.items() if value is None] == ["acquired_s"]
    assert measured.acquired_s == (None,)  # it came later
    assert measure.measure(cut(park(), 20.0)).acquired_s[0] == pytest.approx(whole.acquired_s[0])


def test_who_died_before_the_interruption_died():
    place = park().true_position.copy()
    place[200:, 6] = np.nan
    measured = measure.measure(cut(dataclasses.replace(park(), true_position=place), 8.0))
    assert measured.died == ("CF03",)


def test_growing_metrics_are_not_compared_with_interrupted_runs():
    whole, half = measure.measure(park("a")), measure.measure(cut(park("b"), 20.0))
    for index in ("iae", "messages", "f_hz", "rmse"):  # what fades depends on the length, too
        assert statistics.ratios([half], [whole], index) == [None]
    assert metrics_files.document("x", 1, [whole, half])["cases"]["b"]["ratio"]["itae"] is None


def test_whole_run_may_end_one_sample_early():
    assert not measure.measure(pair(np.ones(16), step=1.0, planned=15.5)).interrupted
    assert measure.measure(pair(np.ones(14), step=1.0, planned=15.5)).interrupted


def test_spread_over_seeds():
    documents = [
        {"seed": k, "cases": {"a": {group: dict.fromkeys(OURS, value) for group in ("mean", "ratio")}}}
        for k, value in enumerate([1.0, 2.0, None, 3.0])
    ]
    found = statistics.across_seeds(documents)
    assert found["seeds"] == [0, 1, 2, 3]
    assert "flawed" not in found
    assert found["cases"]["a"]["mean"]["iae"] == {
        "mean": 2.0,
        "std": 1.0,
        "ci95": pytest.approx(4.302653 / math.sqrt(3.0)),
        "n": 3,
    }
    assert statistics.spread([None]) == statistics.Spread(None, None, None, 0)
    assert statistics.spread([5.0]) == statistics.Spread(5.0, None, None, 1)


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    [(1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (5, 2.57058), (9, 2.26216), (19, 2.09302), (99, 1.98422)],
)
def test_student_quantiles_against_the_printed_table(freedom: int, quantile: float):
    assert statistics.student_95(freedom) == pytest.approx(quantile, rel=1.5e-3)


def test_flawed_seeds_are_named_beside_their_mean():
    whole, half = measure.measure(park("a", seed=1)), measure.measure(cut(park("a", seed=2), 20.0))
    half = msgspec.structs.replace(half, spoiled=("robots failed",))
    documents = [metrics_files.document("x", each.seed, [each]) for each in (whole, half)]
    found = statistics.across_seeds(documents)
    assert found["flawed"] == {"a": {2: ["robots failed", f"interrupted after {half.duration_s:.1f} s"]}}


def test_ratios_pair_seeds_or_divide_by_the_mean():
    runs = [measure.measure(park("a", seed=seed, duration=2.0)) for seed in (1, 2)]
    assert statistics.ratios(runs, runs[::-1], "iae") == [1.0, 1.0]
    iae = [run.mean["iae"] for run in runs]
    assert statistics.ratios(runs, runs[:1], "iae") == [1.0, pytest.approx(iae[1] / iae[0])]


def test_csv_has_a_row_per_robot_and_mean(tmp_path):
    measured = measure.measure(park())
    metrics_files.write_csv(tmp_path / "metrics.csv", [measured])
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["robot"] for row in rows] == [*(robot.robot for robot in measured.robots), "mean"]
    assert float(rows[2]["iae"]) == measured.robots[2].iae
    assert float(rows[2]["phase2_acquired_s"]) == measured.robots[2].phases[0].acquired_s
    assert float(rows[-1]["iae"]) == measured.mean["iae"]
    assert [row["in_mean"] for row in rows] == ["0", *["1"] * 6, ""]


def test_json_holds_everything(tmp_path):
    measured = measure.measure(park(duration=5.0))
    metrics_files.write_json(tmp_path / "metrics.json", [measured])
    assert msgspec.json.decode((tmp_path / "metrics.json").read_bytes(), type=list[CaseMetrics]) == [measured]


@settings(max_examples=20)
@given(turn=st.floats(-3.0, 3.0), x=st.floats(-5.0, 5.0), y=st.floats(-5.0, 5.0))
def test_errors_do_not_depend_on_where_formation_stands(turn: float, x: float, y: float):
    known = park(duration=3.0)
    c, s = math.cos(turn), math.sin(turn)
    place = known.true_position @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [x, y, 0.0]
    moved = measure.measure(dataclasses.replace(known, true_position=place))
    for index in ("iae", "itae", "rmse"):
        assert moved.mean[index] == pytest.approx(measure.measure(known).mean[index], rel=1e-9)


def test_time_without_a_network_is_nobodys_death():
    """A router that was away for 2 s of 10: all robots are unknown then, and come back one after the other."""
    known = pair(1.0 + np.exp(-T))
    place = known.true_position.copy()
    place[(T > 4.0) & (T < 6.0)] = np.nan
    place[(T > 4.0) & (T < 6.4), 1] = np.nan
    measured = measure.measure(dataclasses.replace(known, true_position=place))
    whole = measure.measure(known)
    assert measured.away_s == pytest.approx(2.0, abs=2 * STEP)
    assert measured.died == ()
    assert measured.acquired_s == whole.acquired_s
    assert [robot.known for robot in measured.robots] == [1.0, 1.0]
    assert measured.robots[1].coverage == 1.0
    assert measured.robots[1].settle_s == whole.robots[1].settle_s
    assert measured.mean["iae"] is not None
    assert any("away for 2.0 s" in finding.text for finding in verdict.interruptions([measured]))


@pytest.mark.parametrize("gone", [[0, 1], [1]])
def test_who_does_not_come_back_has_died(gone: list[int]):
    known = pair(1.0 + np.exp(-T))
    place = known.true_position.copy()
    for row in gone:
        place[T > 4.0, row] = np.nan
    measured = measure.measure(dataclasses.replace(known, true_position=place))
    assert measured.away_s == 0.0
    assert measured.robots[1].known < 0.5
    assert measured.robots[1].robot in measured.died


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ([("hazard", "warn: a neighbour is lost: L")], ()),
        (
            [("hazard", "hold: its own position is lost: none"), ("hazard", "over: its own position is lost, after")],
            (),
        ),
        ([("hazard", "over: it does not obey commands to move, after 2.00 s")], ()),
        (
            [
                ("hazard", "warn: it does not obey commands to move: 0.21 m commanded in vain"),
                ("lost", "its process ended"),
            ],
            ("F at 3.0 s: it does not obey commands to move: 0.21 m commanded in vain",),
        ),
        ([("hazard", "warn: its device does not answer: for 1.0 s")],
         ("F at 3.0 s: its device does not answer: for 1.0 s",)),
        ([("hazard", "land: it came down by itself: its motors are off")],
         ("F at 3.0 s: land: it came down by itself: its motors are off",)),
        ([("hazard", "cut: it has tipped over: 80°")], ("F at 3.0 s: cut: it has tipped over: 80°",)),
        (
            [("hazard", "land: it left the arena: 0.3 m outside"), ("hazard", "cut: its landing takes too long: 20 s")],
            ("F at 3.0 s: land: it left the arena: 0.3 m outside; at 4.0 s cut: its landing takes too long: 20 s",),
        ),
        ([("lost", "its process ended (exit code 1)")], ("F at 3.0 s: was lost: its process ended (exit code 1)",)),
    ],
)  # fmt: skip
def test_robots_that_failed_their_part_are_named_first(events: list[tuple[str, str]], expected: tuple[str, ...]):
    made = [Event(3.0 + k, kind, "F", text) for k, (kind, text) in enumerate(events)]
    measured = measure.measure(dataclasses.replace(pair(1.0 + np.exp(-T)), events=tuple(made)))
    assert measured.failures == expected
    first = verdict.findings([measured])[0]
    assert (
        (first.mark == "bad" and first.text == f"Failed in only: {expected[0]}.") if expected else first.mark != "bad"
    )


BLIND = "hold: its own position is lost: the last is 0.51 s old"


@pytest.mark.parametrize(
    ("events", "known", "failed"),
    [
        ([(15.0, BLIND)], 0.75, "its position was known for 75% of the time only"),
        ([(4.0, BLIND), (13.0, "over: its own position is lost, after 8.00 s")], 0.6, "for 60% of the time only"),
        ([(4.0, BLIND), (5.2, "over: its own position is lost, after 0.20 s")], 0.99, ""),
        (
            [(19.0, BLIND), (20.0, "unresolved at the end: its own position is lost, for 1.00 s")],
            0.95,
            "F at 19.0 s: its own position is lost: the last is 0.51 s old, until the end",
        ),
    ],
)
def test_body_that_repeats_an_old_position_has_none(events: list[tuple[float, str]], known: float, failed: str):
    made = tuple(Event(at, "hazard", "F", text) for at, text in events)
    measured = measure.measure(dataclasses.replace(pair(1.0 + np.exp(-T)), events=made))
    robot = measured.robots[1]
    assert robot.known == pytest.approx(known, abs=0.002)
    assert robot.coverage == pytest.approx(known, abs=0.002)
    assert measured.away_s == 0.0
    assert ("F" in measured.died) == (known < 0.95)
    assert bool(measured.failures) == bool(failed)
    assert failed in "".join(measured.failures)


def test_robot_without_position_for_a_fifth_failed():
    known = pair(1.0 + np.exp(-T))
    place = known.true_position.copy()
    place[T > 15.0, 1] = np.nan
    measured = measure.measure(dataclasses.replace(known, true_position=place, position=place))
    assert measured.failures == ("F: its position was known for 75% of the time only",)


def test_time_without_position_is_neither_inside_nor_outside():
    """The process of one robot stood still for 0.6 s, after it had acquired."""
    known = pair(1.0 + np.exp(-T))
    whole = measure.measure(known)
    place = known.true_position.copy()
    place[(T > 6.0) & (T < 6.6), 1] = np.nan
    measured = measure.measure(dataclasses.replace(known, true_position=place))
    assert measured.acquired_s == whole.acquired_s
    (gap,) = measured.gaps
    assert gap == f"{known.robots[1]} from 6.0 to 6.6 s"
    assert any(gap in each.text and each.mark == "fair" for each in verdict.findings([measured]))
    early = known.true_position.copy()
    early[(T > 2.9) & (T < 3.7), 1] = np.nan  # last seen outside: inside for certain only when it is seen again
    acquired = measure.measure(dataclasses.replace(known, true_position=early)).acquired_s[0]
    assert acquired == pytest.approx(3.7, abs=0.1)
