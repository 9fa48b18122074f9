"""The metrics of docs/metrics.md, installed from outside of this repository; and what becomes of wrong ones."""

import csv
import re
import shlex

import msgspec
import numpy as np
import pytest

from agents.plugins import registry
from experiments.definition.experiment import Criterion
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.metrics import metric, signals
from experiments.metrics.measure import measure
from experiments.metrics.metric import Metric
from experiments.metrics.statistics import ratios
from experiments.recording.run_folder import read_origin
from experiments.report import figures, metrics_files, tables
from experiments.sweep import runs
from experiments.sweep.optimise import Limit, Objective, parse_objective
from experiments.sweep.pareto import front
from tests.agents.plugins.test_plugins_outside import install
from tests.commands import ROOT, shell
from tests.experiments.sweep.test_plan import cell
from tests.runs import fly
from tests.small import changed

GUIDE = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
WAY, GAP = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
BROKEN = """

class Broken(Way, frozen=True):
    label = "Broken"

    def of(self, trace, shared):
        return 1 / 0
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The guide's metrics, one that fails, and one that cannot be imported, as an installer would leave them."""
    folder = tmp_path_factory.mktemp("metrics")
    (folder / "my_metrics.py").write_text(f"{WAY}\n\n{GAP}{BROKEN}", encoding="utf-8")
    ((name, made),) = re.findall(r'`(\w+) = "([\w:]+)"` under `\[project\.entry-points\."zenpark\.metrics"\]`', GUIDE)
    given = {name: made, "gap_m": "my_metrics:Gap", "broken": "my_metrics:Broken", "gone": "no_such_module:Way"}
    install(folder, "my-metrics", "0.1", {"zenpark.metrics": given})
    with shell(folder) as command:
        yield folder, command


def test_fields_of_the_page_have_their_shapes(short_trace):
    sizes = {"T": len(short_trace.time), "N": len(short_trace.robots), "E": len(short_trace.plan.pose_links)}
    shapes = {}
    for names, given in re.findall(r"^\| (`.*`) \| (\([TNE].*\)) \|", GUIDE.partition("`shared`")[0], re.MULTILINE):
        fields, found = re.findall(r"`(\w+)`", names), re.findall(r"\(([^)]+)\)", given)
        shapes |= dict(zip(fields, found * (len(fields) // len(found)), strict=True))
    assert {"time", "true_position", "goal", "dropped"} < shapes.keys()
    for name, shape in shapes.items():
        words = [each for each in shape.replace(" ", "").split(",") if each]
        assert np.shape(getattr(short_trace, name)) == tuple(sizes.get(each) or int(each) for each in words), name


def rows_of(file):
    return list(csv.DictReader(file.read_text("utf-8").splitlines()))


@pytest.mark.slow
def test_installed_metric_is_everywhere(installed):
    folder, shelled = installed
    listed = shelled("list")
    assert re.search(r"^Added metrics: broken, gap_m, gone, way_m$", listed.stdout, re.MULTILINE)
    assert "metric gone is left out: plug-in 'gone' (no_such_module:Way) of my-metrics fails to import" in listed.stderr
    assert "Length of the path of a robot" in shelled("explain", "way_m").stdout

    run = shelled("run", "triangle", "--virtual", "--seeds", "2", "--set", "duration_s=5", "--out", "run")
    assert run.returncode == 0, run.stderr
    assert re.search(r"event: f .*, Way \d.* m, .*\(ratios: f .*, Way \d", run.stdout)
    assert "metric broken failed: ZeroDivisionError: division by zero (my_metrics.py:" in run.stdout
    for row in rows_of(folder / "run" / "metrics.csv"):
        known = float(row["way_m"]) > 0.1, row["broken"], bool(row["gap_m"])
        assert known == (True, "", row["robot"] == "mean")
    page = (folder / "run" / "report.html").read_text("utf-8")
    assert all(text in page for text in ("Way [m]", "Length of the path", "Gap [m] of the case", "broken failed"))
    assert "Way [m]" in shelled("report", "run", "--markdown").stdout
    assert read_origin(folder / "run").made_by.plugins == {"my-metrics": "0.1"}


def test_guide_names_all_that_a_metric_gets(short_trace):
    shared = {*vars(signals.Measurement(short_trace)), *vars(signals.Measurement)} - {"of"}
    fields = {*metric._COLUMNS, *(name for name in shared if not name.startswith("_"))}
    assert not {name for name in fields if f"`{name}`" not in GUIDE}, "a row of a table of docs/metrics.md"


class Moves(Metric, frozen=True):
    label = "Moves"

    def of(self, trace, shared):
        place = trace.true_position
        place -= place[0]
        return place[-1, :, 0]


class Grows(Metric, frozen=True):
    label = "Grows"

    def of(self, trace, shared):
        shared.robot_errors[:] *= 2.0
        return shared.robot_errors[-1]


class Late(Metric, frozen=True):
    label = "Late"

    def of(self, trace, shared):
        shared.trace.sent.stamp[:] += 1.0
        return shared.rate


def test_no_metric_changes_what_others_read(short_trace):
    shared = signals.Measurement(short_trace)
    before = short_trace.true_position.copy(), shared.robot_errors.copy(), short_trace.sent.stamp.copy()
    values, failed = metric.values_of({"moves": Moves(), "grows": Grows(), "late": Late()}, shared)
    assert all("read-only" in each for each in failed)
    assert [*map(set, values.values())] == [{None}] * len(failed) == [{None}] * 3
    after = short_trace.true_position, shared.robot_errors, short_trace.sent.stamp
    assert all(np.array_equal(*each, equal_nan=True) for each in zip(before, after, strict=True))


@pytest.mark.slow
def test_installed_metric_is_a_limit_of_a_search(installed):
    (line,) = re.findall(r"^    \./zenpark (sweep .*--optimise.*)$", GUIDE, re.MULTILINE)
    words = [word for word in shlex.split(line) if not word.startswith(("seeds=", "tuning="))]
    short = ["seeds=1:2", "tuning=1001:1006", "--set", "duration_s=1", "--processes", "1", "--anyway", "--no-report"]
    done = installed[1](*words, *short, "--out", "tuned")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^event threshold=.*: keeps Way ratio <= 1.02$", done.stdout, re.MULTILINE)
    assert "note: metric broken failed: ZeroDivisionError" in done.stdout


class Way(Metric, frozen=True):
    label, unit, sums, figure = "Way", "m", True, True

    def of(self, trace, shared):
        return np.nansum(np.linalg.norm(np.diff(trace.true_position, axis=0), axis=2), axis=0)


class Height(Metric, frozen=True):
    label, per, better, needs = "Height", "case", "more", ("goal",)

    def of(self, trace, shared):
        return np.nanmax(trace.goal[..., 2])


class Careless(Height, frozen=True):
    needs = ("true_position",)


class Wrong(Way, frozen=True):
    def of(self, trace, shared):
        return np.zeros(30)


@pytest.fixture
def known(monkeypatch):
    """Says which metrics are installed, by name."""
    return lambda **metrics: monkeypatch.setattr(metric, "installed_metrics", lambda: (metrics, ()))


@pytest.fixture(scope="module")
def short_triangle():
    return changed(load("triangle").cases()["event"].experiment, duration_s=2.0)


@pytest.fixture(scope="module")
def short_trace(short_triangle):
    return fly(short_triangle, case="event").trace


def test_metric_of_wrong_shape_is_unknown(known, short_trace):
    known(wrong=Wrong(), way_m=Way())
    found = measure(short_trace)
    (fault,) = found.metric_faults
    assert fault.startswith("metric wrong failed: ValueError: it gives float64 (30,), not 3 numbers")
    assert fault.endswith(f" (test_metrics_outside.py:{Wrong.of.__code__.co_firstlineno})")


class Strange(Wrong, frozen=True):
    def applies(self, trace):
        return trace.case == "other"


def test_metric_applies_where_it_says(known, short_trace):
    """A metric of another project is neither a failure nor a column of each run of this user."""
    known(strange=Strange(), way_m=Way())
    found = measure(short_trace)
    assert (found.metric_faults, found.mean["strange"]) == ((), None)
    assert {*metric.foreign_metrics([found])} == {"way_m"}
    asked = msgspec.structs.replace(found, criteria=(Criterion(metric="strange", at_most=1.0),))
    assert {*metric.foreign_metrics([asked])} == {"strange", "way_m"}


def test_reports_of_older_runs_lack_a_metric(known, short_trace, tmp_path):
    older = measure(short_trace)
    known(way_m=Way(), height=Height())
    assert (older.mean.get("way_m"), ratios([measure(short_trace)], [older], "way_m")) == (None, [None])
    (table,) = tables.robot_tables([older])
    assert "Way [m]" not in {*table.head, *(row.cells[0] for row in tables.summary_table([older]).rows)}
    newer = msgspec.structs.replace(measure(short_trace), case="newer")
    (row,) = [row for row in tables.summary_table([older, newer]).rows if row.cells[0] == "Way [m]"]
    assert (row.cells[1], row.cells[2] == tables.NONE) == (tables.NONE, False)
    assert figures.robot_bars([older]).axes
    metrics_files.write_csv(tmp_path / "metrics.csv", [older, measure(short_trace)])
    assert [bool(row["way_m"]) for row in rows_of(tmp_path / "metrics.csv")] == [False] * 4 + [True] * 4


def test_sweep_keeps_what_metrics_need(known, short_triangle):
    known(way_m=Way())
    assert runs.lean_enough(Plan(short_triangle))
    ((lean,), _) = runs.fly_seeds(Plan(short_triangle), (1,))
    known(way_m=Way(), height=Height())
    assert not runs.lean_enough(Plan(short_triangle))
    ((whole,), _) = runs.fly_seeds(Plan(short_triangle), (1,))
    assert whole.values.items() > lean.values.items()
    assert (whole.values["height"] is None, whole.metric_faults) == (False, ())


def test_sweep_names_a_field_missing_in_needs(known, short_triangle, short_trace):
    known(goal=Careless())
    assert measure(short_trace).metric_faults == ()
    ((run,), _) = runs.fly_seeds(Plan(short_triangle), (1,))
    assert run.values["goal"] is None
    (fault,) = run.metric_faults
    assert re.search(r"it reads 'goal', which its `needs` does not name.*\(test_metrics_outside\.py:", fault)


def test_store_of_a_sweep_knows_the_metrics(known, short_triangle, monkeypatch):
    found, plan = set(), Plan(short_triangle)
    for metrics in ({}, {"way_m": Way()}):
        known(**metrics)
        found.add(runs.code_of(plan))
    monkeypatch.setattr(runs, "file_digest", lambda _file: "changed")
    assert len(found | {runs.code_of(plan)}) == 3


def test_metrics_of_one_label_are_told_apart():
    labels = metric.terminal_labels({"way_m": Way(), "my_metrics.py:Way": Way(), "my_metrics.py:Height": Height()})
    assert [*labels.values()] == ["Way", "Way (my_metrics.py)", "Height"]


def test_search_for_more_of_a_metric(known):
    known(way_m=Way(), height=Height())
    limits = Limit("way_m", 1.02), Limit("height", 0.5, least=True)
    assert parse_objective("height, way_m<=1.02, height>=0.5") == Objective("height", limits)
    with pytest.raises(DocumentError, match="'way_m>=1' is no limit"):
        parse_objective("height, way_m>=1")

    low, high = cell(messages=0.5, height=0.9), cell(messages=0.5, height=1.2)
    assert front([low, high], "height") == [high]
    assert min(low, high, key=parse_objective("height, messages<=0.6").rank) is high
    assert [parse_objective("messages, height>=1.0").kept(each) for each in (high, low)] == [True, False]


@pytest.mark.parametrize(
    ("name", "facts", "message"),
    [
        ("iae", {}, "zenpark has something of this name"),
        ("acquired", {}, "zenpark has something of this name"),
        ("way-m", {}, "small letters, digits and _"),
        ("way_m", {"label": ""}, "label and unit must be texts"),
        ("way_m", {"needs": ("gaol",)}, "did you mean 'goal'?"),
    ],
)
def test_wrong_metric_is_refused(name, facts, message, monkeypatch):
    made = type(Way)("Made", (Way,), {"__module__": __name__, **facts}, frozen=True)
    monkeypatch.setattr(registry, "struct", lambda _group, _name: made)
    with pytest.raises(registry.PluginError, match=re.escape(message)):
        metric.usable_metric(name)
