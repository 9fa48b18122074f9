"""Sweeps: the numbers of the table, that nothing is run twice, and that only the seeds decide what comes out."""

import json

import numpy as np
import pytest
from msgspec.structs import replace

from agents.errors import ExplainedError
from agents.plugins.triggers import SendOnDelta
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.metrics.measure import measure
from experiments.metrics.statistics import student_95
from experiments.recording.reader import RecordingError
from experiments.run import simulate
from experiments.sweep import page as sweep_page
from experiments.sweep import runs
from experiments.sweep import sweep as sweeps
from experiments.sweep import table as sweep_table
from experiments.sweep.pareto import curves, pareto
from experiments.sweep.plan import Axis
from experiments.sweep.runs import Stuck
from experiments.sweep.store import ORIGIN, Store, StoreOrigin
from experiments.sweep.sweep import folder_of, side_by_side, sweep
from experiments.sweep.table import parameter_columns
from experiments.sweep.workers import Work, workers
from tests.small import small
from tools.commands import sweep as commands
from tools.commands.results import report

pytestmark = pytest.mark.slow  # runs and reports, whole

SHORT = ["duration_s=4.0"]
AXIS = "trigger.threshold=0.005,0.02"


def swept(folder, *given, file="triangle", **more):
    """A sweep, and the number of runs that it took."""
    ran = [0]

    def progress(done, _of):
        ran.append(done)

    options = {"settings": SHORT, "processes": 1, "out": folder, "progress": progress, **more}
    return sweep(file, given or [AXIS, "seeds=3"], **options), ran[-1]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return swept(tmp_path_factory.mktemp("done"))[0]


def test_the_table_has_the_figures_of_single_runs(done):
    periodic, _, event = done.rows
    assert (periodic.case, periodic.parameters, periodic.reference, periodic.seeds) == ("periodic", {}, True, 3)
    assert (event.case, event.parameters, event.reference) == ("event", {"trigger.threshold": 0.02}, False)
    read = load("triangle", *SHORT, "cases.event.trigger.threshold=0.02")
    single = [simulate(read, seed=seed) for seed in (1, 2, 3)]
    mine, theirs = (np.array([run.metrics[case].mean["iae"] for run in single]) for case in ("event", "periodic"))
    found, ratios = event.ratio["iae"], mine / theirs
    half = student_95(2) * ratios.std(ddof=1) / np.sqrt(3)
    wanted = [mine.mean(), ratios.mean(), half]
    assert [event.mean["iae"].mean, found.mean, found.ci95] == pytest.approx(wanted, rel=1e-11)
    assert event.mean["messages"].mean == np.mean([run.metrics["event"].mean["messages"] for run in single])
    assert periodic.ratio["messages"].mean == 1.0
    gaps = [robot.gap_min_s for run in single for robot in measure(run.traces["event"]).robots]
    assert event.gap_min_s == pytest.approx(min(gap for gap in gaps if gap is not None))


def test_nothing_is_run_twice(done):
    again, ran = swept(done.folder)
    assert (ran, again.rows, again.notes) == (0, done.rows, ())
    more, ran = swept(done.folder, AXIS, "seeds=4")
    assert (ran, more.rows[0].seeds) == (3, 4)
    assert swept(done.folder, "trigger.threshold=0.005,0.01,0.02", "seeds=2:4")[1] == 3


def test_a_sweep_that_was_interrupted_goes_on(done, tmp_path):
    def three(done, _of):
        if done >= 3:
            raise KeyboardInterrupt

    part, _ = swept(tmp_path, progress=three, most_seeds=2)
    assert part.missing == 5
    assert [(row.seeds, row.missing) for row in part.rows] == [(2, 1), (2, 1)]  # cases take turns
    assert "2 (1 missing)" in str(part)
    with (tmp_path / "runs.jsonl").open("ab") as file:
        file.write(b'{"cell":"cut off in mid')
    for runs_left in (5, 0):
        whole, ran = swept(tmp_path)
        assert (ran, whole.missing, whole.rows) == (runs_left, 0, done.rows)


def test_reference_of_a_named_case_is_announced(done):
    found, _ = swept(done.folder, cases=["event"])
    assert [row.case for row in found.rows] == ["periodic", "event", "event"]
    assert found.notes == ("'periodic' runs as well: ratios are relative to it, the first case of the file",)


def test_changed_file_or_version_reruns_affected_runs(tmp_path, monkeypatch):
    file = tmp_path / "mine.toml"
    text = load("triangle").text.replace("duration_s = 15.0", "duration_s = 3.0")
    file.write_text(text)
    given = {"file": file, "settings": []}
    swept(tmp_path / "runs", AXIS, "seeds=2", **given)
    file.write_text(text.replace("threshold = 0.01", "threshold = 0.01, minimum_interval_s = 0.1"))
    found, ran = swept(tmp_path / "runs", AXIS, "seeds=2", **given)
    assert found.notes == ("the experiment file has changed: affected runs are repeated",)
    assert ran == 4  # the two cells of `event`; `periodic` is as it was
    assert min(row.gap_min_s for row in found.rows if row.case == "event") == pytest.approx(0.1)
    monkeypatch.setattr(sweeps, "version", lambda _name: "99.0")
    found, _ = swept(tmp_path / "runs", AXIS, "seeds=1", **given)
    assert found.notes == ("this is zenpark 99.0, not 0.1.0: all runs are repeated",)


def test_runs_that_fail_are_counted_and_named(tmp_path, monkeypatch):
    real = runs.simulate

    def stuck(plan, seed, *, lean):
        if plan.trigger == SendOnDelta(threshold=0.02) and seed == 2:
            raise Stuck("not airborne after 60 s: CF01")
        return real(plan, seed, lean=lean)

    monkeypatch.setattr(runs, "simulate", stuck)
    found, _ = swept(tmp_path)
    assert [(row.seeds, row.failed) for row in found.rows] == [(3, 0), (3, 0), (2, 1)]
    assert found.failures == ("event trigger.threshold=0.02, seed 2: not airborne after 60 s: CF01",)
    assert found.rows[2].ratio["iae"].n == 2


def test_sweeps_that_cannot_be_made_are_refused(tmp_path):
    def meanwhile(_done, _of):
        with pytest.raises(DocumentError, match="another sweep is at work in it"):
            swept(tmp_path, "seeds=1")

    swept(tmp_path, "seeds=1", progress=meanwhile)
    for given, message in (("tuning=5", "nothing to tune"), ("trigger.threshold=0.01:0.02:log", "how many values")):
        with pytest.raises(DocumentError, match=message):
            swept(tmp_path, given)
    (tmp_path / ORIGIN).unlink()
    (tmp_path / ORIGIN).mkdir()
    with Store(tmp_path) as kept, pytest.raises(DocumentError):
        kept.changed_since(StoreOrigin("1", "2", "3"))


def test_number_of_parallel_flights_depends_on_robots():
    crowds = (dict.fromkeys([f"R{k}" for k in range(robots)], "khepera4") for robots in (4, 1000))
    assert [side_by_side(Plan(small(crowd, duration_s=45.0))) for crowd in crowds] == [100, 1]


def test_workers_of_other_code_or_nowhere_are_refused():
    with workers(None, 1) as working, pytest.raises(ExplainedError, match="another version of zenpark"):
        list(working.done([Work("x", b'{"title":"","robots":{},"duration_s":1}', (1,), "other", 0.0)]))
    with pytest.raises(ExplainedError, match=r"--scheduler nonsense: this is no address; write one as tcp://"):
        workers("nonsense", None).__enter__()


def test_curves_go_along_the_first_parameter(tmp_path):
    found, _ = swept(tmp_path, "trigger.threshold=0.005,0.02", "formation.gain=2,3", "seeds=1")
    drawn = curves([row for row in found.rows if not row.reference]).items()
    along = {name: [row.parameters["trigger.threshold"] for row in rows] for name, rows in drawn}
    assert along == {("event", f"gain = {gain}"): [0.005, 0.02] for gain in (2, 3)}
    axes = pareto(found.rows).axes[0]
    assert [text.get_text() for text in axes.texts] == ["threshold = 0.005 m", "0.02"]
    assert axes.get_legend_handles_labels()[1][1:] == ["event", "gain = 2", "gain = 3", "periodic (reference)"]
    page = sweep_page.table(found.rows, found.metrics, "a title")
    assert page.head[:3] == ("Case", "threshold [m]", "gain")
    assert "In all cells: " in page.note
    pareto(found.rows[:1]).canvas.draw()  # nothing but the reference
    row = found.rows[-1]
    both = replace(row, parameters={**row.parameters, "cases.other.trigger.threshold": 0.3})
    names = ["trigger.threshold [m]", "cases.other.trigger.threshold", "gain"]
    assert list(parameter_columns([row, both])) == names


def test_long_folder_name_is_cut_and_stays_unique():
    read, paths = load("triangle"), ["trigger.threshold", "cases.event.trigger.minimum_interval_s"]
    axes = [Axis(f"{path}=1", path, ("1",), None) for path in paths]
    short, *cut = [folder_of(read, some, "sweep").name for some in (axes[:1], axes, axes[::-1])]
    assert (short, [len(name) for name in cut]) == ("triangle-sweep-trigger.threshold", [60, 60])
    assert len({name[-8:] for name in cut}) == 2


def test_the_command_writes_table_figures_and_page(done, capsys):
    given, options = [AXIS, "seeds=3"], {"settings": SHORT, "out": str(done.folder), "processes": 1}
    assert commands.sweep("triangle", given, **options) == 0
    assert "event     threshold=0.02" in capsys.readouterr().out
    assert (
        (done.folder / "sweep.csv")
        .read_text()
        .startswith("case,trigger.threshold,reference,seeds,failed,missing,f_hz,")
    )
    table = json.loads((done.folder / "sweep.json").read_text())
    assert (table["reference"], table["seeds"], len(table["cells"])) == ("periodic", [1, 2, 3], 3)
    assert table["cells"][2]["ratio"]["iae"]["mean"] == done.rows[2].ratio["iae"].mean
    page = (done.folder / "sweep.html").read_text()
    assert "./zenpark sweep triangle trigger.threshold=0.005,0.02 seeds=3 --set duration_s=4.0" in page
    assert page.count("<svg") == 2
    assert {file.name for file in (done.folder / "figures").iterdir()} == {"pareto_iae.svg", "pareto_itae.svg"}
    assert commands.sweep("triangle", given, **options, as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["cells"] == table["cells"]
    sweep_table.write_json(
        done.folder / "sweep.json", sweep_table.document("t", [1], done.rows[:1], done.metrics, tuning=[7])
    )
    with pytest.raises(RecordingError, match="a search of another version; make it again"):
        report([str(done.folder)])
