"""Laws that remember in tables, figures and exported files; they have no errors of links."""

import csv

import numpy as np
import pytest

from experiments.metrics.measure import measure
from experiments.report import export, figures, metrics_files, verdict
from experiments.report.tables import whole_tables
from tests.experiments.virtual_time.test_gallery import trace_from

CASES = ("periodic", "event")


@pytest.fixture(scope="module")
def traces():
    return {case: trace_from("average", case, "duration_s=5") for case in CASES}


@pytest.fixture(scope="module")
def measured(traces):
    return [measure(each) for each in traces.values()]


def test_indices_of_links_are_unknown_without_errors(measured):
    case = measured[0]
    robot = case.robots[0]
    assert (case.mean["j2"], case.mean["iae"], case.acquired_s) == (None, None, (None,))
    assert (robot.settle_s, robot.coverage, robot.residual, robot.iae) == (None, None, None, None)
    assert robot.known == 1.0
    texts = " ".join(each.text for each in verdict.findings(measured))
    assert "formation" not in texts
    assert "fewer transmissions than periodic" in texts


def test_measures_are_means_over_run_and_end(traces, measured):
    values = traces["periodic"].measures["disagreement"]
    found = measured[0].robots[2].measures["disagreement"]
    assert found.mean == pytest.approx(np.nanmean(values[:, 2]))
    assert found.end == pytest.approx(np.nanmean(values[traces["periodic"].time > 4.0 + 1e-9, 2]), rel=0.05)
    assert measured[0].measures["disagreement"].mean == pytest.approx(np.nanmean(values))
    (table,) = [each for each in whole_tables(measured) if each.head[0] == "Measures of the law"]
    assert [row.cells[0] for row in table.rows] == ["disagreement, mean", "disagreement, at the end"]


def test_figures_show_measures_and_no_errors(traces, measured):
    drawn = figures.all_figures(measured, list(traces.values()))
    assert {"measures", "robot_bars", "global_bars"} < {*drawn}
    assert "errors" not in drawn
    (axes,) = drawn["measures"].axes
    assert axes.get_ylabel() == "disagreement"
    assert len([line for line in axes.lines if line.get_linewidth() == 1.3]) == len(CASES)
    assert len(drawn["robot_bars"].axes) == 1  # of f alone


def rows_of(file):
    return list(csv.DictReader(file.read_text().splitlines()))


def test_files_have_columns_of_the_law(tmp_path, traces, measured):
    export.write_csv(traces, tmp_path / "trajectories.csv")
    rows = [row for row in rows_of(tmp_path / "trajectories.csv") if row["case"] == "event"]
    known = traces["event"]
    assert float(rows[-1]["memory_x"]) == known.memory["x"][-1, -1, 0]
    assert float(rows[-1]["measure_disagreement"]) == known.measures["disagreement"][-1, -1]
    assert rows[-1]["error"] == ""
    metrics_files.write_csv(tmp_path / "metrics.csv", measured)
    rows = rows_of(tmp_path / "metrics.csv")
    assert float(rows[0]["measure_disagreement_end"]) == measured[0].robots[0].measures["disagreement"].end
    means = [row for row in rows if row["robot"] == "mean"]
    assert float(means[1]["measure_disagreement_mean"]) == measured[1].measures["disagreement"].mean
    metrics_files.write_json(tmp_path / "metrics.json", measured)
    assert metrics_files.read_json(tmp_path / "metrics.json") == measured
    assert "measures" in metrics_files.document("", 1, measured)["cases"]["event"]


def test_numbers_of_one_variable_are_columns_each(tmp_path):
    known = trace_from("leader-observer", "periodic", "duration_s=3")
    wide = next(name for name, values in known.memory.items() if values.shape[2] > 1)
    export.write_csv({"periodic": known}, tmp_path / "trajectories.csv")
    head = (tmp_path / "trajectories.csv").read_text().splitlines()[0].split(",")
    assert f"memory_{wide}[1]" in head
