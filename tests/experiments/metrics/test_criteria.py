"""Criteria of a file: what passes, what does not and why, over cases and seeds, in files and on the command line."""

import csv
import dataclasses
import json
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from agents.network.messages import Event
from agents.safety.hazards import QUIET_S
from experiments.catalogue import index
from experiments.definition.experiment import Criterion
from experiments.file.document import loads, write_json
from experiments.metrics.comparable import reasons, with_failures
from experiments.metrics.criteria import document, has_passed, judge
from experiments.metrics.measure import measure
from experiments.metrics.signals import network_away
from experiments.metrics.statistics import ratios
from experiments.report import metrics_files
from experiments.report.page import number
from experiments.report.tables import criteria_table
from experiments.report.verdict import criteria_met, findings
from experiments.run import reopen, simulate, simulate_seeds
from tests.commands import invoke
from tests.experiments.traces import crowd, cut

FILE = index.find_file("triangle").read_text("utf-8")
SHORT = ("duration_s=4.0", "timeline=[]", "cases.periodic.trigger.period_s=0.1", "cases.event.trigger.threshold=0.05")
HALF = '[[criteria]]\nmetric = "f_hz"\ncase = "event"\nrelative_to = "periodic"\nat_most = 0.5\nwhy = "events save"\n'
TIGHT = '[[criteria]]\nmetric = "rmse"\nof = "worst"\nat_most = 0.001\nwhy = "nobody is that good"\n'


@pytest.fixture(scope="module")
def cases():
    return list(simulate(loads(FILE + HALF + TIGHT, *SHORT)).metrics.values())


def with_criteria(cases, *criteria):
    return [replace(case, criteria=criteria) for case in cases]


def answer(cases, **criterion):
    return [each.passed for each in judge(with_criteria(cases, Criterion(**criterion)))]


def test_each_criterion_is_judged_in_its_cases(cases):
    judged = [(each.case, each.passed) for each in judge(cases)]
    assert judged == [("event", True), ("periodic", False), ("event", False)]
    first, *missed, met = criteria_met(cases)
    assert (first.mark, first.text) == ("bad", "Not passed: 1 of 3 criteria are met.")
    assert all("nobody is that good" in each.text for each in missed)
    assert "event" in met.text
    assert [row.cells[3] for row in criteria_table(cases).rows] == ["1 of 1", "0 of 1", "0 of 1"]
    assert (criteria_table(with_criteria(cases)).rows, document([])) == ((), {})
    found = document(judge(cases))
    assert (found["passed"], found["criteria"][0]["metric"]) == (False, "f_hz")
    assert found["criteria"][0]["values"]["1"] < 0.5


@pytest.mark.parametrize(
    ("criterion", "passed"),
    [
        ({"metric": "f_hz", "at_least": 9.0, "at_most": 11.0}, True),
        ({"metric": "f_hz", "at_most": 9.0}, False),
        ({"metric": "f_hz", "of": "KH02", "at_least": 9.0}, True),
        ({"metric": "collisions", "of": "worst", "at_most": 0.0}, True),
        ({"metric": "residual", "at_most": 1.0}, True),
        ({"metric": "received", "at_least": 1.0}, True),
        ({"metric": "j2", "of": "worst", "at_least": 0.1}, True),
        ({"measure": "spread", "at_most": 1.0}, False),
    ],
)
def test_numbers_that_can_be_judged(cases, criterion, passed):
    assert answer(cases, case="periodic", **criterion) == [passed]


def test_the_value_farthest_out_of_range_is_named(cases):
    found = [replace(case, seed=k, case="one") for k, case in enumerate(cases)]
    event, periodic = sorted(case.mean["f_hz"] for case in cases)
    middle = 0.5 * (event + periodic)
    for below, above, farthest in ((0.1, 0.2, event), (0.2, 0.1, periodic)):
        limits = Criterion(metric="f_hz", at_least=middle - below, at_most=middle + above)
        assert f"is {number(farthest)} for 2 of 2 seeds" in criteria_met(with_criteria(found, limits))[1].text


def test_what_was_not_run_is_not_judged(cases):
    event = cases[1:]
    for names in ({"case": "periodic"}, {"case": "event", "relative_to": "periodic"}):
        assert answer(event, metric="f_hz", at_most=1.0, **names) == [None]
    assert [has_passed(judge(each)) for each in (event, with_criteria(event, cases[0].criteria[0]))] == [False, None]
    short = [replace(case, interrupted=True) for case in cases]
    assert answer(short, metric="f_hz", at_least=0.0) == [False, False]


def test_the_worst_robot_has_one_limit():
    with pytest.raises(ValueError, match="the worst robot has one limit"):
        Criterion(metric="f_hz", of="worst", at_least=3.0, at_most=50.0)


@pytest.mark.parametrize("spoiled", ["periodic", "event"])
def test_no_ratio_of_a_spoiled_run_passes(cases, spoiled):
    found = [replace(case, spoiled=("disturbed",) if case.case == spoiled else ()) for case in cases]
    assert answer(found, metric="f_hz", case="event", relative_to="periodic", at_most=9.0) == [False]


def test_every_seed_must_pass():
    runs = simulate_seeds(loads(FILE, *SHORT), [1, 2, 3], cases=["event"])
    found = [case for run in runs for case in run.metrics.values()]
    middle = sorted(case.mean["rmse"] for case in found)[1]
    judged = with_criteria(found, Criterion(metric="rmse", at_most=middle))
    (only,) = judge(judged)
    assert (len(only.values), len(only.failed)) == (3, 1)
    assert "for 1 of 3 seeds" in criteria_met(judged)[1].text


def test_a_case_keeps_criteria_when_it_is_written():
    assert all(b'"relative_to"' in write_json(case) for case in loads(FILE + HALF).cases().values())


@pytest.mark.slow
@pytest.mark.parametrize(("limits", "code", "options"), [(HALF, 0, ["--no-report"]), (HALF + TIGHT, 1, [])])
def test_a_run_ends_by_its_criteria(limits, code, options, tmp_path):
    file, out = tmp_path / "task.toml", tmp_path / "run"
    file.write_text(FILE + limits, "utf-8")
    words = ["run", file, "--virtual", "--json", "--out", out, "--set", SHORT[0], "--set", SHORT[1], *options]
    done = invoke(*words, code=code)
    assert json.loads(done.stdout)["passed"] is reopen(out).summary()["passed"] is (code == 0)
    assert code == 0 or "nobody is that good" in (out / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def live_trace():
    return dataclasses.replace(crowd(3, "periodic", duration=4.0), clock="real")


def measured_with(live_trace, **columns):
    arrays = {name: np.full(3, value) for name, value in columns.items()}
    return measure(dataclasses.replace(live_trace, **arrays))


def texts(*cases):
    return " ".join(each.text for each in findings(cases))


@pytest.mark.parametrize(
    ("columns", "event", "reason"),
    [
        ({"missed_deadlines": 10, "ticks": 90}, None, "10 % of the deadlines were missed"),
        ({"missed_deadlines": 300, "ticks": 100}, None, "75 % of the deadlines were missed"),
        ({"missed_deadlines": 1, "ticks": 999}, None, None),
        ({"lost": 100}, None, "of the poses were lost"),
        ({"lost": 1}, None, None),
        ({}, Event(1.0, "late", "CF01", "began 0.70 s after the common start"), ""),
        ({}, Event(1.0, "late", "CF01", "still waits for the start; ordered again"), None),
        ({}, Event(1.0, "unread", "CF01", "could not read 3 messages on park/A/pose"), ""),
        ({}, Event(2.0, "lost", "CF01", "its process ended"), "robots failed"),
        ({}, Event(-3.0, "failed", "CF01", "takes no part: it is not ready: it is idle"), "robots failed"),
    ],
)
def test_what_spoils_a_run(live_trace, columns, event, reason):
    events = live_trace.events if event is None else (*live_trace.events, event)
    found = measured_with(dataclasses.replace(live_trace, events=events), **columns)
    assert reasons(found) == found.spoiled
    assert reason in found.spoiled[0] if reason is not None else not found.spoiled


def held(*ends):
    begin = "hold: ordered to hold: by an operator"
    over = [f"over: ordered to hold, after {end - at:.2f} s" for at, end in pairwise(ends)]
    return [Event(at + k % 2 * QUIET_S, "hazard", "CF01", over[k - 1] if k % 2 else begin) for k, at in enumerate(ends)]


def given(*times):
    return [Event(at, "hazard", "CF01", "warn: was given trigger.threshold = 0.02 by an operator") for at in times]


def changed_by(who, word="remove", leaves=("robot", "landing: ordered to leave")):
    return [Event(2.0, word, "CF01", f"asked by {who}"), Event(2.1, leaves[0], "CF01", leaves[1])]


@pytest.mark.parametrize(
    ("events", "spoiled"),
    [
        (held(1.0, 1.7), None),
        (held(0.5, 1.0, 2.5, 3.0), "CF01 was held by an operator for 1.0 of 4 s"),
        (held(3.0), "CF01 was held by an operator for 1.0 of 4 s"),
        (held(3.5), None),
        (held(-3.0, -0.5), None),
        (changed_by("ann"), "CF01 was removed by an operator at 2.1 s"),
        (changed_by("ann", "restart", ("silent", "its lifeline is cut")), "CF01 was restarted by an operator at 2.1 s"),
        (changed_by("an operator", "replace"), "CF01 was replaced by an operator at 2.1 s"),
        (changed_by("ann", "replace", ("left", "it is down")), "CF01 was replaced by an operator at 2.1 s"),
        (changed_by("on_loss", "restart"), None),
        (changed_by("ann")[:1], None),
        (given(1.0, 2.0), "CF01 was given trigger.threshold = 0.02 by an operator at 1.0 s"),
    ],
)
def test_run_that_an_operator_changed_is_spoiled(live_trace, events, spoiled):
    """And fails by nothing of that: a robot that was taken out is known for a while only."""
    place = live_trace.true_position.copy()
    if spoiled and "at 2.1 s" in spoiled:
        place[live_trace.time > 2.1, live_trace.robots.index("CF01")] = np.nan
    every = tuple(sorted((*live_trace.events, *events), key=lambda event: event.stamp))
    found = measure(dataclasses.replace(live_trace, events=every, true_position=place, position=place))
    assert found.failures == ()
    assert (spoiled in found.spoiled) if spoiled else not found.spoiled
    assert spoiled is None or spoiled in texts(found)


def test_losses_that_no_recorder_saw_spoil(live_trace):
    good = measure(live_trace)
    still = replace(good, robots=(replace(good.robots[0], missed_share=0.06), *good.robots[1:]), missed_share=0.009)
    assert reasons(still) == (f"{good.robots[0].robot} missed 5 % of its deadlines or more",)
    assert reasons(replace(good, world_factor=0.5)) == ("the world ran at 0.50 of real time",)
    assert with_failures(good, []) is good
    told = with_failures(good, ["lost CF01, CF02", "the recorder ended"])
    assert (told.failures, told.spoiled) == (("lost CF01, CF02", "the recorder ended"), ("robots failed",))
    known = replace(good, failures=("CF01 at 2.0 s: was lost: killed",))
    assert with_failures(known, ["lost CF01"]) is known


def test_spoiled_runs_have_neither_ratio_nor_praise(live_trace, tmp_path):
    good, bad = measure(live_trace), measured_with(live_trace, missed_deadlines=50)
    other = replace(bad, case="event")
    assert "good" in [each.mark for each in findings([good, replace(good, case="event")])]
    assert "good" not in [each.mark for each in findings([good, other])]
    for pair in ((good, other), (other, good)):
        assert ratios([pair[1]], [pair[0]], "f_hz") == [None]
        assert "Its errors relative" not in texts(*pair)
    event = metrics_files.document("x", 1, [good, other])["cases"]["event"]
    assert (event["spoiled"], {*event["ratio"].values()}) == ([*bad.spoiled], {None})
    metrics_files.write_csv(tmp_path / "m.csv", [good, other])
    rows = list(csv.DictReader((tmp_path / "m.csv").read_text("utf-8").splitlines()))
    assert [row["spoiled"] for row in rows] == ["0"] * 4 + ["1"] * 4


def test_a_spoiled_seed_is_left_out_of_ratios(live_trace):
    first = [replace(measure(live_trace), seed=seed) for seed in (1, 2, 3)]
    others = [replace(each, case="event") for each in first]
    rate = others[1].mean["f_hz"]
    others[1] = replace(others[1], spoiled=("robots failed",), mean=others[1].mean | {"f_hz": 100.0 * rate})
    assert ratios(others, first, "iae") == ratios(first, others, "iae") == [1.0, None, 1.0]
    assert f"f {number(rate)} rather than {number(rate)} Hz (seeds compared: 2 of 3)" in texts(*first, *others)


def test_integrals_over_holes_are_not_compared(live_trace):
    holed, away = (live_trace.true_position.copy() for _ in range(2))
    holed[40:48, 0] = away[40:48] = np.nan  # too short to be dead; and all of them
    whole = measure(live_trace)
    holed, away = (measure(dataclasses.replace(live_trace, true_position=p, position=p)) for p in (holed, away))
    assert ratios([away], [whole], "iae") == [pytest.approx(1.0, abs=0.1)]  # absence of all is none
    assert ratios([holed], [whole], "iae") == ratios([whole], [holed], "itae") == [None]
    assert ratios([holed], [whole], "f_hz") == [pytest.approx(1.0)]


def test_what_was_never_measured_is_unknown(live_trace):
    silent = texts(measure(dataclasses.replace(live_trace, ticks=np.array([0, 100, 100]))))
    assert "Whether CF01 missed deadlines is unknown" in silent
    assert "what CF01 received is unknown" in silent
    mute = measure(dataclasses.replace(live_trace, sent=live_trace.sent.take(live_trace.sent.stamp < 0.0)))
    assert "whether any would have been lost is unknown." in texts(mute)


def test_a_shorter_run_is_not_compared(live_trace):
    whole, short = measure(live_trace), replace(measure(cut(live_trace, 2.0)), case="short")
    for name in ("f_hz", "iae", "rmse", "messages"):  # what fades depends on the length, too
        assert ratios([short], [whole], name) == [None]
    assert metrics_files.document("x", 1, [whole, short])["cases"]["short"]["ratio"]["itae"] is None


def test_a_hole_excuses_nobody_before_it():
    alive = np.ones((100, 2), dtype=bool)
    alive[20:60, 0] = alive[50:70, 1] = False  # one robot was gone long before the network was
    away_s, away = network_away(alive, np.arange(100) * 0.1)
    assert away_s == pytest.approx(1.0)
    assert np.flatnonzero(away).tolist() == list(range(50, 70))
