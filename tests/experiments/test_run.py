"""A run: of robots without links, from the file to the report, and as a notebook shows it."""

import os
import re
import sys
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from experiments import cores
from experiments.check.check import check
from experiments.file.document import loads, read
from experiments.metrics.measure import measure
from experiments.metrics.signals import Measurement
from experiments.recording.reader import RecordingError
from experiments.run import CHECKOUT, FigureSet, Run, reopen, show, simulate_seeds
from experiments.sweep.workers import workers
from tests.experiments.traces import crowd
from tools.commands import run as commands

DUEL = """
title = "duel"
duration_s = 9.0
arena = { size = [3.0, 3.0, 2.0] }
world = { engine = "pymunk" }
[robots]
TB01 = { kind = "turtlebot3", start = [-1.0, 0.0] }
TB02 = { kind = "turtlebot3", start = [1.0, 0.0, 3.14159] }
[[timeline]]
at_s = 0.0
robot = "TB01"
plan = { kind = "waypoints", points = [[1.0, 0.0]], speed = 0.2 }
[[timeline]]
at_s = 0.0
robot = "TB02"
plan = { kind = "waypoints", points = [[-1.0, 0.0]], speed = 0.2 }
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "duel.toml"
    path.write_text(DUEL)
    return path


@pytest.mark.slow
def test_they_push_each_other_and_it_is_reported(file, tmp_path, capsys):
    assert commands.run(str(file), virtual=True, out=str(tmp_path / "run")) == 1
    printed = capsys.readouterr()
    assert "TB01 at 7.5 s: it does not obey commands to move" in printed.err + printed.out
    assert "no link was measured" in printed.out
    assert "One collision in default: TB01–TB02" in printed.out
    page = re.sub(r"<[^>]+>", " ", (tmp_path / "run" / "report.html").read_text("utf-8"))
    known = ("TB01–TB02", "Not where the plan wanted them at the end of default: TB01 by", "never stayed")
    assert [part in page for part in known] == [True, True, False]
    run = reopen(tmp_path / "run")
    (blow,) = [each for each in run.traces["default"].contacts if {each.first, each.second} == {"TB01", "TB02"}]
    assert blow.stamp == pytest.approx(5.5, abs=0.1)  # 0.895 m at 0.2 m/s, behind a plan by 1 s
    assert 0.05 < blow.impulse < 0.4  # reduced mass 0.5 kg, closing at 0.4 m/s
    assert 0.0 <= blow.overlap < 0.001
    assert all(robot.short > 0.5 for robot in run.metrics["default"].robots)  # neither arrives


@pytest.mark.slow
def test_unlinked_robot_goes_its_way_beside_a_formation(file):
    third = '[robots.KH01]\nkind = "khepera4"\nstart = [-1.0, 0.6]\n[formation.links]\n"TB01 > KH01" = 0.6\n'
    file.write_text(DUEL + third)
    errors = [finding for finding in check(read(file)) if finding.severity == "error"]
    assert not [error for error in errors if "falls into" in error.message], errors


@pytest.fixture(scope="module")
def crowded():
    trace = crowd(3, duration=1.0)
    return Run("Three <robots>", 1, {trace.case: trace}, {trace.case: measure(trace)})


def test_a_run_shows_its_verdict_and_table(crowded):
    html = crowded._repr_html_()
    assert "<b>Three &lt;robots&gt;</b>" in html
    assert "✓ No pose was lost" in html
    assert html.count("<table>") == 1
    assert len(repr(crowded)) < 200
    with pytest.raises(RecordingError, match="holds no recording"):
        reopen("tests")


@pytest.mark.slow
def test_figures_show_themselves_and_are_kept(crowded, tmp_path):
    figures = crowded.figures(width=7.16)
    assert isinstance(figures, FigureSet)
    assert figures._repr_html_().count("<svg") == len(figures)
    assert figures["errors"].get_figwidth() == 7.16
    assert "<svg" in show(figures["errors"], tmp_path / "figures" / "errors")._repr_svg_()
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["errors.pdf", "errors.svg"]


class Frame(dict):
    """Data frame of either library, which keeps what has replaced NaN."""

    unknown = "NaN"

    def fill_nan(self, value):
        self.unknown = value
        return self


@pytest.mark.parametrize("installed", ["pandas", "polars"])
def test_frames_are_of_the_library_that_is_there(crowded, monkeypatch, installed):
    for library in ("pandas", "polars"):
        monkeypatch.setitem(sys.modules, library, None)  # its import fails
    with pytest.raises(ImportError, match="neither pandas nor polars"):
        crowded.to_frame()
    monkeypatch.setitem(sys.modules, installed, SimpleNamespace(DataFrame=Frame))
    columns = crowded.to_frame()
    assert columns.unknown == {"pandas": "NaN", "polars": None}[installed]
    assert columns["robot"] == ["CF01", "CF02", "CF03"]
    assert {"seed", "case", "f_hz", "iae", "near_gap"} <= columns.keys()
    assert [type(each) for each in columns["acquired_s"]] == [float] * 3, "none has acquired: NaN"
    trace = next(iter(crowded.traces.values()))
    series = trace.to_frame()
    assert {len(column) for column in series.values()} == {3 * len(trace.time)}
    assert (series["robot"][:4], series["time"][3]) == (["CF01", "CF02", "CF03", "CF01"], trace.time[1])
    assert [series["true_x"][4], series["goal_z"][-1]] == [trace.true_position[1, 1, 0], trace.goal[-1, -1, 2]]
    assert np.array_equal(series["error"], Measurement(trace).robot_errors.ravel(), equal_nan=True)


CELLS = (
    "from zenpark import load, reopen, simulate\n"
    'run = simulate(load("triangle", "duration_s=2.0"), folder="kept")\nrun',
    'run.figures()["errors"]',
    "run.figures()",
    'reopen("kept")',
)


@pytest.mark.system
def test_jupyter_shows_run_figures_and_the_reread_run(tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(CHECKOUT), str(CHECKOUT / "face")]))
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    nbclient.NotebookClient(book, timeout=150, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [cell.outputs[-1].data for cell in book.cells]
    assert "<table>" in shown[0]["text/html"]
    assert "<svg" in shown[1]["image/svg+xml"]
    assert shown[2]["text/html"].count("<svg") >= 4
    assert shown[3]["text/html"] == shown[0]["text/html"]
    assert all(len(each["text/plain"]) < 2000 for each in shown)


def test_without_shared_memory_one_process_does_all(monkeypatch, capsys):
    """As in a container without /dev/shm."""
    monkeypatch.setattr(cores, "ProcessPoolExecutor", Mock(side_effect=FileNotFoundError(2, "No such file")))
    with workers(None, 4) as working:
        assert (working.executor, working.count()) == (None, 1)
    assert "all is done in one" in capsys.readouterr().err
    runs = simulate_seeds(loads(DUEL, "duration_s=0.2"), [1, 2, 3], processes=3)
    assert [run.seed for run in runs] == [1, 2, 3]
    assert all(run.metrics for run in runs)
