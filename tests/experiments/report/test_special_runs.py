"""Reports of laws that remember, which have no errors of links, and of a modelled network."""

import csv

import numpy as np
import pytest

from experiments.definition.experiment import ChannelTable, LinkChannelTable
from experiments.metrics.measure import measure
from experiments.report import export, figures, metrics_files, report, typeset, verdict
from experiments.report.page import NONE, number
from experiments.report.tables import network_tables, proof_tables, robot_tables, summary_table, whole_tables
from tests.experiments.traces import pair
from tests.runs import flown, fly
from tests.small import changed, reference


@pytest.fixture(scope="module")
def traces():
    return {case: flown("average", case, "duration_s=5").trace for case in ("periodic", "event")}


@pytest.fixture(scope="module")
def measured(traces):
    return [measure(each) for each in traces.values()]


def test_indices_of_links_are_unknown_without_errors(measured):
    case = measured[0]
    robot = case.robots[0]
    assert (case.mean["j2"], case.mean["iae"], case.acquired_s) == (None, None, (None,))
    assert (robot.settle_s, robot.coverage, robot.residual, robot.iae, robot.known) == (None, None, None, None, 1.0)
    texts = " ".join(each.text for each in verdict.findings(measured))
    assert [part in texts for part in ("formation", "fewer transmissions than periodic")] == [False, True]


def test_metrics_unknown_in_all_cases_are_left_out(measured):
    """A paper has no row of dashes; chosen metrics stay."""
    summary, (robots, _) = summary_table(measured), robot_tables(measured)
    assert [row.cells[0] for row in summary.rows if {*row.cells[1:]} == {NONE}] == []
    assert {"f [Hz]", "IAE [m s]"} & {row.cells[0] for row in summary.rows} == {"f [Hz]"}
    assert [head for head, *cells in zip(robots.head, *(row.cells for row in robots.rows), strict=True)
            if {*cells} == {NONE}] == []  # fmt: skip
    assert "--" not in typeset.latex([summary, robots])
    (row,) = summary_table(measured, ["iae"]).rows
    assert row.cells[1:] == (NONE, NONE)
    never = measure(pair(np.full(200, 2.0)))
    assert NONE in [row.cells[1] for row in summary_table([never]).rows if row.cells[0].startswith("Acquired")]


def test_measures_are_means_over_run_and_end(traces, measured):
    values = traces["periodic"].measures["disagreement"]
    found = measured[0].robots[2].measures["disagreement"]
    assert found.mean == pytest.approx(np.nanmean(values[:, 2]))
    assert found.end == pytest.approx(np.nanmean(values[traces["periodic"].time > 4.0 + 1e-9, 2]), rel=0.05)
    assert measured[0].measures["disagreement"].mean == pytest.approx(np.nanmean(values))
    rows = [row.cells[0] for row in summary_table(measured).rows]
    assert rows[-2:] == ["disagreement (mean)", "disagreement (end)"]
    drawn = figures.all_figures(measured, list(traces.values()))
    assert {"measures", "robot_bars", "global_bars"} < {*drawn}
    assert "errors" not in drawn
    (axes,) = drawn["measures"].axes
    thick = [line for line in axes.lines if line.get_linewidth() == 1.3]
    assert (axes.get_ylabel(), len(thick), len(drawn["robot_bars"].axes)) == (
        "disagreement",
        2,
        2,
    )  # the last of f and its measure


def rows_of(file):
    return list(csv.DictReader(file.read_text().splitlines()))


def test_files_have_columns_of_the_law(tmp_path, traces, measured):
    way, metrics = tmp_path / "trajectories.csv", tmp_path / "metrics.json"
    export.write_csv(traces, way)
    last, known = rows_of(way)[-1], traces["event"]
    found = float(last["memory_x"]), float(last["measure_disagreement"]), last["case"], last["error"]
    assert found == (known.memory["x"][-1, -1, 0], known.measures["disagreement"][-1, -1], "event", "")
    metrics_files.write_csv(tmp_path / "metrics.csv", measured)
    first, *_, mean = rows_of(tmp_path / "metrics.csv")
    found = float(first["measure_disagreement_end"]), float(mean["measure_disagreement_mean"])
    ends = measured[0].robots[0].measures["disagreement"].end, measured[1].measures["disagreement"].mean
    assert found == ends
    metrics_files.write_json(metrics, measured)
    assert metrics_files.read_json(metrics) == measured
    assert "measures" in metrics_files.document("", 1, measured)["cases"]["event"]
    export.write_csv({"periodic": flown("leader-observer", "periodic", "duration_s=3").trace}, way)
    assert {"memory_v[0]", "memory_v[1]"} <= rows_of(way)[0].keys()  # numbers of one variable


@pytest.fixture(scope="module")
def dropping_run():
    spared = {"TB01 > KH01": LinkChannelTable(loss=0.0, delay_s=0.03)}
    bad = ChannelTable(delay_s=0.05, loss=0.2, links=spared)
    return fly(changed(reference("periodic"), duration_s=4.0, timeline=[], channel=bad), case="bad")


@pytest.mark.slow
def test_dropped_differs_from_lost(dropping_run):
    measured = dropping_run.metrics
    assert (measured.modelled, measured.lost) == (True, 0)
    links = {(each.sender, each.receiver): each for each in measured.link_deliveries}
    assert len(links) == 21
    spared = links["TB01", "KH01"]
    assert (spared.dropped, spared.received) == (0, 200)  # that of the end is under way; one from before the start came
    assert (spared.delay_mean, spared.delay_max) == pytest.approx((0.03, 0.03))
    for each in measured.link_deliveries:
        if each is not spared:
            found = each.dropped, each.received + each.dropped, each.delay_mean
            assert found == (pytest.approx(40, abs=24), pytest.approx(200, abs=4), pytest.approx(0.05))
    assert measured.dropped == sum(each.dropped for each in measured.link_deliveries)
    for robot in measured.robots:
        assert robot.dropped == sum(each.dropped for ends, each in links.items() if ends[0] == robot.robot)


@pytest.mark.slow
def test_report_has_dropped_poses_by_link(tmp_path, dropping_run):
    measured = dropping_run.metrics
    said = [each.text for each in verdict.findings([measured])]
    assert any(text.startswith("No pose was lost") for text in said)
    (text,) = [text for text in said if text.startswith(f"The modelled network dropped {measured.dropped} of 4")]
    assert text.endswith("at most 50.0 ms.")
    (table,) = network_tables([measured])
    assert table.rows[-1].cells[0] == "all"
    assert ("TB01 > KH01", "200", "0", "0", "30.0", "30.0") in [row.cells for row in table.rows]
    assert proof_tables([measured])[0].head[-2:] == ("Lost", "Dropped")
    dropped = ("Dropped", number(measured.dropped))
    assert dropped in [row.cells for table in whole_tables([measured]) for row in table.rows]
    assert "TB01 &gt; KH01" in report.write(tmp_path, [dropping_run.trace]).read_text("utf-8")
    plain = measure(pair(np.ones(100)))
    assert (plain.modelled, network_tables([plain])) == (False, ())
    assert proof_tables([plain])[0].head[-1] == "Lost"
