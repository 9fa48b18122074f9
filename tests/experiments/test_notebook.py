"""A run as a notebook shows it."""

from __future__ import annotations

import os
import sys
from types import SimpleNamespace

import pytest

from experiments.metrics.measure import measure
from experiments.recording.reader import RecordingError
from experiments.run import CHECKOUT, FigureSet, Run, reopen, show
from tests.experiments.traces import crowd


@pytest.fixture(scope="module")
def run():
    trace = crowd(3, duration=1.0)
    return Run("Three <robots>", 1, {trace.case: trace}, {trace.case: measure(trace)})


def test_a_run_shows_its_verdict_and_table(run):
    html = run._repr_html_()
    assert "<b>Three &lt;robots&gt;</b>" in html
    assert "✓ No pose was lost" in html
    assert html.count("<table>") == 1
    assert len(repr(run)) < 200


@pytest.mark.slow
def test_figures_show_themselves_and_are_kept(run, tmp_path):
    figures = run.figures(width=7.16)
    assert isinstance(figures, FigureSet)
    assert figures._repr_html_().count("<svg") == len(figures)
    assert figures["errors"].get_figwidth() == 7.16
    assert "<svg" in show(figures["errors"], tmp_path / "figures" / "errors")._repr_svg_()
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["errors.pdf", "errors.svg"]


def test_a_folder_may_be_text(tmp_path):
    with pytest.raises(RecordingError, match="holds no recording"):
        reopen(str(tmp_path))


def without(monkeypatch, *libraries):
    for library in libraries:
        monkeypatch.setitem(sys.modules, library, None)  # its import fails


@pytest.mark.parametrize("installed", ["pandas", "polars"])
def test_frames_are_of_the_library_that_is_there(run, monkeypatch, installed):
    without(monkeypatch, "pandas", "polars")
    with pytest.raises(ImportError, match="neither pandas nor polars"):
        run.to_frame()
    monkeypatch.setitem(sys.modules, installed, SimpleNamespace(DataFrame=lambda columns: columns))
    columns = run.to_frame()
    assert columns["robot"] == ["CF01", "CF02", "CF03"]
    assert {"seed", "case", "f_hz", "iae", "near_gap"} <= columns.keys()


@pytest.mark.parametrize(("library", "other"), [("pandas", "polars"), ("polars", "pandas")])
def test_a_frame_has_numbers_where_some_are_unknown(run, monkeypatch, library, other):
    pytest.importorskip(library)
    without(monkeypatch, other)
    frame = run.to_frame()
    assert type(frame).__module__.startswith(library)
    assert frame.shape[0] == 3
    assert frame["robot"].to_list() == ["CF01", "CF02", "CF03"]
    assert str(frame["acquired_s"].dtype).lower() == "float64", "none has acquired: NaN"
    assert str(frame["messages"].dtype).lower() == "int64"


CELLS = (
    "from zenpark import load, reopen, simulate\n"
    'run = simulate(load("triangle", "duration_s=2.0"), folder="kept")\nrun',
    'run.figures()["errors"]',
    "run.figures()",
    'reopen("kept")',
)


@pytest.mark.system
@pytest.mark.timeout(200)
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
