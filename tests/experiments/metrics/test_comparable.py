"""A run that was spoiled gives no ratio and no praise; runs of other length or coverage are not compared."""

import csv
import dataclasses

import numpy as np
import pytest
from msgspec.structs import replace

from agents.network.messages import Event
from experiments.metrics.comparable import reasons, with_failures
from experiments.metrics.measure import measure
from experiments.metrics.signals import network_away
from experiments.metrics.statistics import ratios
from experiments.report import metrics_files
from experiments.report.verdict import findings
from tests.experiments.traces import crowd, cut


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
    ],
)
def test_what_spoils_a_run(live_trace, columns, event, reason):
    events = live_trace.events if event is None else (*live_trace.events, event)
    found = measured_with(dataclasses.replace(live_trace, events=events), **columns)
    assert reasons(found) == found.spoiled
    assert reason in found.spoiled[0] if reason is not None else not found.spoiled


def test_losses_that_no_recorder_saw_spoil(live_trace):
    good = measure(live_trace)
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
    document = metrics_files.document("x", 1, [good, other])["cases"]["event"]
    assert document["spoiled"] == list(bad.spoiled)
    assert set(document["ratio"].values()) == {None}
    metrics_files.write_csv(tmp_path / "m.csv", [good, other])
    rows = list(csv.DictReader((tmp_path / "m.csv").read_text("utf-8").splitlines()))
    assert [row["spoiled"] for row in rows] == ["0"] * 4 + ["1"] * 4


def test_a_spoiled_seed_is_left_out_of_ratios(live_trace):
    first = [replace(measure(live_trace), seed=seed) for seed in (1, 2, 3)]
    others = [replace(each, case="event") for each in first]
    others[1] = replace(others[1], spoiled=("robots failed",))
    assert ratios(others, first, "iae") == [1.0, None, 1.0]
    assert ratios(first, others, "iae") == [1.0, None, 1.0]
    assert "seeds compared: 2 of 3" in texts(*first, *others)


def test_integrals_over_holes_are_not_compared(live_trace):
    def with_hole(rows):
        place = live_trace.true_position.copy()
        place[40:48, rows] = np.nan  # too short to be dead
        return measure(dataclasses.replace(live_trace, true_position=place, position=place))

    whole, holed = measure(live_trace), with_hole(0)
    assert ratios([with_hole(slice(None))], [whole], "iae") == [pytest.approx(1.0, abs=0.1)]  # absence of all is none
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
    for index in ("f_hz", "iae", "rmse", "messages"):  # what fades depends on the length, too
        assert ratios([short], [whole], index) == [None]
    assert metrics_files.document("x", 1, [whole, short])["cases"]["short"]["ratio"]["itae"] is None


def test_a_hole_excuses_nobody_before_it():
    alive = np.ones((100, 2), dtype=bool)
    alive[20:60, 0] = alive[50:70, 1] = False  # one robot was gone long before the network was
    away_s, away = network_away(alive, np.arange(100) * 0.1)
    assert away_s == pytest.approx(1.0)
    assert np.flatnonzero(away).tolist() == list(range(50, 70))
