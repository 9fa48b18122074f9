"""Sweeps: the numbers of the table, that nothing is run twice, and that only the seeds decide what comes out."""

import json

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from agents.errors import ExplainedError
from agents.plugins.triggers import SendOnDelta
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.metrics.measure import measure
from experiments.metrics.statistics import spread, student_95
from experiments.recording.reader import RecordingError
from experiments.run import simulate
from experiments.sweep import page as sweep_page
from experiments.sweep import runs
from experiments.sweep import sweep as sweeps
from experiments.sweep import table as sweep_table
from experiments.sweep.pareto import curves, front, pareto
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


class Progress:
    """Progress of a sweep: the number of runs so far."""

    def __init__(self, end_after=None):
        self.ran, self._end_after = 0, end_after

    def __call__(self, done, of):
        self.ran = done
        if self._end_after is not None and done >= self._end_after:
            raise KeyboardInterrupt


def swept(folder, *given, progress=None, **more):
    options = {"settings": SHORT, "processes": 1, "out": folder, **more}
    return sweep("triangle", given or [AXIS, "seeds=3"], progress=progress or Progress(), **options)


def tables(found):
    """The files of the table, as bytes."""
    sweep_table.write_csv(found.folder / "t.csv", found.rows)
    sweep_table.write_json(found.folder / "t.json", sweep_table.document("T", found.seeds, found.rows))
    return (found.folder / "t.csv").read_bytes(), (found.folder / "t.json").read_bytes()


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return swept(tmp_path_factory.mktemp("done"))


def test_the_table_has_the_figures_of_single_runs(done):
    periodic, _, event = done.rows
    assert (periodic.case, periodic.parameters, periodic.reference, periodic.seeds) == ("periodic", {}, True, 3)
    assert (event.case, event.parameters, event.reference) == ("event", {"trigger.threshold": 0.02}, False)
    read = load("triangle", *SHORT, "cases.event.trigger.threshold=0.02")
    single = [simulate(read, seed=seed) for seed in (1, 2, 3)]
    mine = [run.metrics["event"].mean["iae"] for run in single]
    theirs = [run.metrics["periodic"].mean["iae"] for run in single]
    ratios = np.array(mine) / np.array(theirs)
    assert event.mean["iae"].mean == pytest.approx(np.mean(mine), rel=1e-12)
    assert event.ratio["iae"].mean == pytest.approx(ratios.mean(), rel=1e-12)
    half = student_95(2) * ratios.std(ddof=1) / np.sqrt(3)
    assert event.ratio["iae"].ci95 == pytest.approx(half, rel=1e-9)
    assert event.mean["messages"].mean == np.mean([run.metrics["event"].mean["messages"] for run in single])
    assert periodic.ratio["messages"].mean == 1.0
    gaps = [robot.gap_min_s for run in single for robot in measure(run.traces["event"]).robots]
    assert event.gap_min_s == pytest.approx(min(gap for gap in gaps if gap is not None))


def test_nothing_is_run_twice(done):
    progress = Progress()
    again = swept(done.folder, progress=progress)
    assert (progress.ran, again.rows, again.notes) == (0, done.rows, ())
    more = swept(done.folder, AXIS, "seeds=4", progress=progress)
    assert (progress.ran, more.rows[0].seeds) == (3, 4)
    progress = Progress()
    swept(done.folder, "trigger.threshold=0.005,0.01,0.02", "seeds=2:4", progress=progress)
    assert progress.ran == 3


def test_a_sweep_that_was_interrupted_goes_on(done, tmp_path):
    part = swept(tmp_path, progress=Progress(end_after=3), most_seeds=2)
    assert (part.missing, [row.seeds for row in part.rows]) == (5, [2, 2])  # cases take turns
    with (tmp_path / "runs.jsonl").open("ab") as file:
        file.write(b'{"cell":"cut off in mid')
    whole = swept(tmp_path, progress=(progress := Progress()))
    assert (progress.ran, whole.missing) == (5, 0)
    assert tables(whole) == tables(done)
    assert swept(tmp_path, progress=(quiet := Progress())).rows == done.rows
    assert quiet.ran == 0


def test_changed_file_is_noticed_and_reruns_affected_runs(tmp_path):
    file = tmp_path / "mine.toml"
    text = load("triangle").text.replace("duration_s = 15.0", "duration_s = 3.0")
    file.write_text(text)
    folder = tmp_path / "runs"
    sweep(file, [AXIS, "seeds=2"], out=folder, processes=1)
    file.write_text(text.replace("threshold = 0.01", "threshold = 0.01, minimum_interval_s = 0.1"))
    found = sweep(file, [AXIS, "seeds=2"], out=folder, processes=1, progress=(progress := Progress()))
    assert found.notes == ("the experiment file has changed: affected runs are repeated",)
    assert progress.ran == 4  # the two cells of `event`; `periodic` is as it was
    assert min(row.gap_min_s for row in found.rows if row.case == "event") == pytest.approx(0.1)


def test_another_version_is_noticed(tmp_path, monkeypatch):
    swept(tmp_path, "seeds=1")
    monkeypatch.setattr(sweeps, "version", lambda _name: "99.0")
    assert swept(tmp_path, "seeds=1").notes == ("this is zenpark 99.0, not 0.1.0: all runs are repeated",)


def test_runs_that_fail_are_counted_and_named(tmp_path, monkeypatch):
    real = runs.simulate

    def stuck(plan, seed, *, lean):
        if plan.trigger == SendOnDelta(threshold=0.02) and seed == 2:
            raise Stuck("not airborne after 60 s: CF01")
        return real(plan, seed, lean=lean)

    monkeypatch.setattr(runs, "simulate", stuck)
    found = swept(tmp_path)
    assert [(row.seeds, row.failed) for row in found.rows] == [(3, 0), (3, 0), (2, 1)]
    assert found.failures == ("event trigger.threshold=0.02, seed 2: not airborne after 60 s: CF01",)
    assert found.rows[2].ratio["iae"].n == 2


def test_two_sweeps_do_not_share_a_folder(tmp_path):
    def meanwhile(_done, _of):
        with pytest.raises(DocumentError, match="another sweep is at work in it"):
            swept(tmp_path, "seeds=1")

    swept(tmp_path, "seeds=1", progress=meanwhile)


def test_origin_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / ORIGIN).mkdir()
    with Store(tmp_path) as kept, pytest.raises(DocumentError):
        kept.changed_since(StoreOrigin("1", "2", "3"))


def test_tuning_word_and_open_range_belong_to_search(tmp_path):
    with pytest.raises(DocumentError, match="there is nothing to tune"):
        swept(tmp_path, "tuning=5")
    with pytest.raises(DocumentError, match="how many values"):
        swept(tmp_path, "trigger.threshold=0.01:0.02:log")


@pytest.mark.parametrize(("robots", "flights"), [(4, 100), (1000, 1)])
def test_number_of_parallel_flights_depends_on_robots(robots, flights):
    crowd = dict.fromkeys([f"R{k}" for k in range(robots)], "khepera4")
    assert side_by_side(Plan(small(crowd, duration_s=45.0))) == flights


def test_workers_of_other_code_or_nowhere_are_refused():
    with workers(None, 1) as working, pytest.raises(ExplainedError, match="another version of zenpark"):
        list(working.done([Work("x", b'{"title":"","robots":{},"duration_s":1}', (1,), "other", 0.0)]))
    with pytest.raises(ExplainedError, match=r"--scheduler nonsense: this is no address; write one as tcp://"):
        workers("nonsense", None).__enter__()


def test_the_front_has_what_no_other_beats(done):
    rows = [row for row in done.rows if not row.reference]
    points = [(row.ratio["messages"].mean, row.ratio["iae"].mean) for row in rows]
    best = front(rows)
    for row, (messages, iae) in zip(rows, points, strict=True):
        beaten = any(fewer <= messages and less < iae for fewer, less in points)
        assert (row in best) != beaten
    pareto(done.rows[:1]).canvas.draw()  # nothing but the reference


def test_curves_go_along_the_first_parameter(tmp_path):
    found = swept(tmp_path, "trigger.threshold=0.005,0.02", "formation.gain=2,3", "seeds=1")
    drawn = curves([row for row in found.rows if not row.reference])
    assert {name: len(rows) for name, rows in drawn.items()} == {("event", "gain = 2"): 2, ("event", "gain = 3"): 2}
    assert [row.parameters["trigger.threshold"] for row in drawn["event", "gain = 2"]] == [0.005, 0.02]
    axes = pareto(found.rows).axes[0]
    assert axes.get_xlabel() == "messages relative to periodic"
    assert [text.get_text() for text in axes.texts] == ["threshold = 0.005 m", "0.02"]
    assert axes.get_legend_handles_labels()[1][1:] == ["event", "gain = 2", "gain = 3", "periodic (reference)"]
    page = sweep_page.table(found.rows, "a title")
    assert page.head[:3] == ("Case", "threshold [m]", "gain")
    assert "In all cells: " in page.note


def test_tied_cells_share_front_and_parameter_columns(done):
    (row, *_) = [row for row in done.rows if not row.reference]
    other = replace(row, case="other", parameters={"cases.other.trigger.threshold": 0.3}, units={})
    assert front([row, other]) == [row, other]
    assert parameter_columns([row, other]) == {"threshold [m]": ["0.005", "0.3"]}
    both = replace(row, parameters={**row.parameters, **other.parameters})
    assert list(parameter_columns([row, both])) == ["trigger.threshold [m]", "cases.other.trigger.threshold"]


def test_search_figures_are_drawn_at_any_width(done, tmp_path):
    tried = [msgspec.to_builtins(row) for row in done.rows if not row.reference]
    file = tmp_path / "sweep.json"
    sweep_table.write_json(file, sweep_table.document("t", [1], done.rows[:1], tuning=[7], tried=tried))
    assert report([str(tmp_path)], width=7.16) == 0
    assert 'width="515.52pt"' in (tmp_path / "figures" / "pareto_iae.svg").read_text()
    sweep_table.write_json(file, sweep_table.document("t", [1], done.rows[:1], tuning=[7]))
    with pytest.raises(RecordingError, match="a search of another version; make it again"):
        report([str(tmp_path)])


def test_long_folder_name_is_cut_and_stays_unique():
    read, paths = load("triangle"), ["trigger.threshold", "cases.event.trigger.minimum_interval_s"]
    axes = [Axis(f"{path}=1", path, ("1",), None) for path in paths]
    names = [folder_of(read, some, "sweep").name for some in (axes[:1], axes, axes[::-1])]
    assert names[0] == "triangle-sweep-trigger.threshold"
    assert names[1].startswith("triangle-sweep-trigger.threshold-cases.")
    assert [len(name) for name in names[1:]] == [60, 60]
    assert len({name[-8:] for name in names}) == 3


def typed(folder, *given, **more):
    return commands.sweep("triangle", given, settings=SHORT, out=str(folder), processes=1, **more)


def test_the_command_writes_table_figures_and_page(done, capsys):
    assert typed(done.folder, AXIS, "seeds=3") == 0
    said = capsys.readouterr().out
    assert "event     threshold=0.02" in said
    assert (done.folder / "sweep.csv").read_text().startswith("case,trigger.threshold,reference,seeds,failed,f_hz,")
    table = json.loads((done.folder / "sweep.json").read_text())
    assert (table["reference"], table["seeds"], len(table["cells"])) == ("periodic", [1, 2, 3], 3)
    assert table["cells"][2]["ratio"]["iae"]["mean"] == done.rows[2].ratio["iae"].mean
    page = (done.folder / "sweep.html").read_text()
    assert "./zenpark sweep triangle trigger.threshold=0.005,0.02 seeds=3 --set duration_s=4.0" in page
    assert page.count("<svg") == 2
    assert {file.name for file in (done.folder / "figures").iterdir()} == {"pareto_iae.svg", "pareto_itae.svg"}
    assert typed(done.folder, AXIS, "seeds=3", as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["cells"] == table["cells"]


def test_the_page_says_who_needs_fewest_messages(done):
    found = [finding.text for finding in sweep_page.fewest(done.rows)]
    assert all(text.startswith("Fewest messages with an IAE ratio of at most ") for text in found)
    far = [row if row.reference else replace(row, ratio={**row.ratio, "iae": spread([1.2 + k])})
           for k, row in enumerate(done.rows)]  # fmt: skip
    (finding,) = sweep_page.fewest(far)
    nearest = next(row for row in far if not row.reference)
    assert finding.text.startswith(f"No cell has an IAE ratio of at most 1.05; the nearest: {nearest.label}: ")
