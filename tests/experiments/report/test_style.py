"""Figures have the same bytes whatever style the process has, from a file or from another program."""

import io
import os
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from experiments.check.analysis import Analysis
from experiments.check.ideal_run import predict
from experiments.metrics.measure import measure
from experiments.metrics.statistics import Spread
from experiments.report import export, figures, style, trajectories
from experiments.sweep.pareto import pareto
from experiments.sweep.table import CellRow
from tests.experiments.traces import pair
from tests.runs import flown

STYLE_FILE = "matplotlibrc"
HOSTILE = """savefig.bbox: tight
savefig.facecolor: pink
savefig.format: pdf
lines.marker: o
lines.linewidth: 4
axes.grid: True
axes.facecolor: black
axes.labelcolor: yellow
axes.titlelocation: left
axes.prop_cycle: cycler('color', ['r', 'g'])
axes.formatter.use_locale: True
axes3d.grid: False
text.color: red
xtick.direction: in
figure.facecolor: gray
figure.dpi: 37
figure.constrained_layout.w_pad: 0.3
legend.frameon: True
legend.edgecolor: red
hatch.color: red
errorbar.capsize: 9
image.cmap: hot
pdf.fonttype: 3
pdf.compression: 0
svg.fonttype: none
path.sketch: 1, 100, 2
animation.bitrate: 10
"""
ONE = """
import numpy as np
from experiments.report import figures, style
from tests.experiments.traces import pair
print(style.svg(figures.errors([pair(1.0 + np.exp(-np.arange(0.0, 3.0, 0.02)))])), end="")
"""
CURVE = pair(1.0 + np.exp(-np.arange(0.0, 3.0, 0.02)))


def cells():
    """Two cells of one curve and their reference."""
    one = {"messages": 1.0, "iae": 1.0}
    for k, ratios in enumerate([one, {"messages": 0.4, "iae": 1.02}, {"messages": 0.1, "iae": 1.2}]):
        known = {name: Spread(value, 0.01, 0.01, 9) for name, value in ratios.items()}
        parameters = {} if k == 0 else {"trigger.threshold": 0.01 * k}
        case = "event" if k else "periodic"
        yield CellRow(case, parameters, {}, {}, k == 0, 9, 0, known, known, 1.0, 0.02)


def pictures(folder, traces, known):
    """Bytes of whatever is drawn, by name."""
    made = figures.all_figures([measure(trace) for trace in traces], traces)
    made["pareto"] = pareto(list(cells()))
    made["expected"] = trajectories.expected_motion({"periodic": known})
    found = {name: style.svg(figure) for name, figure in made.items()}
    for name in ("errors", "pareto"):
        style.save(made[name], folder, name, pdf=True)
        found[f"{name}.pdf"] = (folder / f"{name}.pdf").read_bytes()
        page = io.BytesIO()
        made[name].savefig(page, format="pdf", metadata={"CreationDate": None})  # as docs/runs.md does
        found[f"{name}, saved"] = page.getvalue()
        assert b"/Type3" not in page.getvalue()
    export.write_video({"event": traces[1]}, folder / "film.gif", speed=40.0)
    return found | {"film": (folder / "film.gif").read_bytes()}


@pytest.mark.nightly
def test_no_style_of_the_process_changes_pictures(tmp_path):
    (tmp_path / STYLE_FILE).write_text(HOSTILE)
    traces = [flown("triangle", case, "duration_s=3.0", "timeline=[]").trace for case in ("periodic", "event")]
    known = Analysis(traces[0].plan, predict(traces[0].plan))
    plain = pictures(tmp_path / "plain", traces, known)
    with mpl.rc_context():
        mpl.rc_file(tmp_path / STYLE_FILE)
        before = dict(mpl.rcParams)
        styled = pictures(tmp_path / "styled", traces, known)
        assert dict(mpl.rcParams) == before, "the style of the process stays as it is"
    assert len(plain) > 10
    assert [name for name, picture in plain.items() if styled[name] != picture] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "variable"),
    [
        (True, None),
        pytest.param(False, "MATPLOTLIBRC", marks=pytest.mark.nightly),
        pytest.param(False, "MPLCONFIGDIR", marks=pytest.mark.nightly),
    ],
)
def test_style_files_change_no_figure(folder, variable, tmp_path):
    (tmp_path / STYLE_FILE).write_text(HOSTILE)
    settings = {} if variable is None else {variable: str(tmp_path)}
    out = subprocess.run(
        [sys.executable, "-c", f"import matplotlib; print(matplotlib.matplotlib_fname())\n{ONE}"],
        cwd=tmp_path if folder else tmp_path.parent,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])} | settings,
        capture_output=True,
        check=True,
        text=True,
    ).stdout
    used, _, drawing = out.partition("\n")
    assert Path(used).resolve() == tmp_path / STYLE_FILE if not folder else used == STYLE_FILE
    assert drawing == style.svg(figures.errors([CURVE]))
