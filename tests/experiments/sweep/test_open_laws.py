"""Own laws that remember get what built-in laws get: errors, rows of `check`, coloured links, sweeps, Pareto fronts."""

import re

import msgspec
import numpy as np
import pytest

from experiments.check.check import examine
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.metrics.metric import law_metrics
from experiments.metrics.results import CaseMetrics
from experiments.report import figures, replay
from experiments.report.tables import summary_metrics
from experiments.run import simulate
from experiments.scene.stage import BARE, LinkTracker, SceneModel
from experiments.sweep import page, table
from experiments.sweep.optimise import parse_objective
from experiments.sweep.sweep import sweep
from tests.commands import invoke
from tests.small import COUNTING_LAW

METRIC = '''
import numpy as np
from zenpark import Metric


class Place(Metric, frozen=True):
    """Distance from the origin at the end."""

    label, unit, figure = "Place", "m", True

    def of(self, trace, shared):
        return np.linalg.norm(trace.true_position[-1, :, :2], axis=1)
'''
FILE = """
title = "Three keep offsets"
duration_s = 8.0
robots.A = { kind = "khepera4", start = [0.0, 0.0] }
robots.B = { kind = "khepera4", start = [-0.6, 0.5] }
robots.C = { kind = "khepera4", start = [-0.6, -0.5] }
formation.law = "displacement"
formation.stiffness = 0.3
formation.links = { "A > B" = { offset = [-0.4, 0.3] }, "A > C" = { offset = [-0.4, -0.3] } }
disturbance.all.position_sigma = 0.0003
cases.periodic.trigger = { kind = "periodic", period_s = 0.1 }
cases.event.trigger = { kind = "send-on-delta", threshold = 0.01 }
criteria = [{ metric = "place.py:Place", at_most = 2.0 }]
"""
pytestmark = pytest.mark.slow
OWN = 'formation.law="own.py:Counting"'


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("open")
    for name, text in (("own.py", COUNTING_LAW), ("place.py", METRIC), ("three.toml", FILE)):
        (folder / name).write_text(text, "utf-8")
    return folder / "three.toml"


@pytest.fixture(scope="module")
def swept(file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweeps")
    axes = ["trigger.threshold=0.01,0.03", "seeds=1"]
    return [
        sweep(file, axes, settings=settings, out=folder / name, processes=1)
        for name, settings in (("built-in", ()), ("own", (OWN,)))
    ]


def test_sweeps_of_own_laws_have_the_same_errors(swept):
    built_in, own = swept
    for theirs, ours in zip(built_in.rows, own.rows, strict=True):
        for name in ("iae", "itae", "rmse", "acquired_s", "place.py:Place"):
            assert ours.mean[name].mean == pytest.approx(theirs.mean[name].mean, rel=1e-6), name
        assert (ours.acquired, ours.mean["messages"].mean) == (1.0, theirs.mean["messages"].mean)
    assert "Place ratio" in str(own)
    assert "push (end) [m]" in str(own)


def test_pages_and_fronts_are_the_same(swept):
    written = [page.write(found, "sweep").parent / "figures" for found in swept]
    built_in, own = ({file.stem for file in folder.glob("*.svg")} for folder in written)
    assert built_in == {"pareto_iae", "pareto_itae", "pareto_place.py_Place"}
    assert own == {*built_in, "pareto_measure_push_mean"}
    assert len(swept[1].pareto().axes[0].lines) == len(swept[0].pareto().axes[0].lines)


def test_tables_keep_what_metrics_are(swept, tmp_path):
    found, kept = swept[1], tmp_path / "sweep.json"
    table.write_json(kept, table.document("", found.seeds, found.rows, found.metrics))
    _, rows, metrics = table.read_json(kept)
    assert tuple(rows) == found.rows
    assert metrics["measure_push_mean"].head == "push (mean) [m]"
    chosen = page.table(rows, metrics, chosen=["measure_push_end", "place.py:Place"])
    assert chosen.head[-2:] == ("push (end) [m]", "Place ratio")
    limits = parse_objective("messages, place.py:Place<=1.1, measure_push_mean<=2", found.metrics).limits
    assert [limit.index for limit in limits] == ["place.py:Place", "measure_push_mean"]
    with pytest.raises(DocumentError, match="name the measure in MEASURES of the law"):
        parse_objective("messages, measure_pull_mean<=2", found.metrics)


def test_check_has_the_same_rows(file):
    (_, theirs), (findings, ours) = (examine(load(file, *settings)) for settings in ((), (OWN,)))
    of_loop = {"loop_gain", "slowest_mode_s"}  # a law that remembers has no matrix that is known
    for case in theirs:
        built_in, own = msgspec.structs.asdict(theirs[case]), msgspec.structs.asdict(ours[case])
        assert {name for name, value in own.items() if value is None} - of_loop == {
            name for name, value in built_in.items() if value is None
        }
        for name in ("acquired_s", "end_error_mm", "residual_mm", "smallest_eigenvalue"):
            assert own[name] == pytest.approx(built_in[name], abs=1e-3), name
    assert {"realisable", "rigid", "acquired"} <= {finding.code for finding in findings}


def test_check_says_what_it_cannot_know(file):
    rows = invoke("check", file, "--set", OWN).stdout.splitlines()
    unknown = [row.strip() for row in rows if row.endswith("not known for a law with a memory")]
    assert [re.split(" {2,}", row)[0] for row in unknown] == ["loop gain (unstable from 2)", "slowest mode"]


def test_metrics_without_a_limit_are_measured(file, tmp_path):
    """A metric in a file is a column by `--metrics`, and in runs by `metrics` of the file; no criterion names it."""
    bare = tmp_path / "bare.toml"
    text = re.sub(r"criteria = .*\n", "", FILE)
    for name, content in (("place.py", METRIC), ("bare.toml", text)):
        (tmp_path / name).write_text(content, "utf-8")
    words = ("trigger.threshold=0.01,0.03", "seeds=1", "--metrics", "place.py:Place", "--processes", "1", "--no-report")
    said = invoke("sweep", bare, *words, "--out", tmp_path / "swept").stdout
    assert "Place ratio" in said
    _, rows, metrics = table.read_json(tmp_path / "swept" / "sweep.json")
    assert metrics["place.py:Place"].head == "Place [m]"
    assert rows[0].mean["place.py:Place"].mean == pytest.approx(0.52, abs=0.2)
    page.pictures(tmp_path, rows, metrics, joined=True, width=3.5)
    assert (tmp_path / "figures" / "pareto_place.py_Place.svg").is_file()
    run = simulate(load(bare, 'metrics=["place.py:Place"]'), cases=["periodic"])
    assert run.metrics["periodic"].mean["place.py:Place"] == pytest.approx(rows[0].mean["place.py:Place"].mean)
    assert "passed" not in run.summary()
    report = summary_metrics([*run.metrics.values()])
    assert "place.py:Place" in report
    for names, said in {
        ('metrics=["place.py:Plaice"]',): "it has no Plaice, only Place",
        ('metrics=["iea"]',): "did you mean 'iae'?",
        ('cases.event.metrics=["iae"]',): "a case cannot hold metrics",
    }.items():
        with pytest.raises(DocumentError, match=re.escape(said)):
            load(bare, *names)


def test_links_have_colours_or_are_grey(file):
    plan = load(file, OWN).cases()["event"]
    place = np.array([[0.0, 0.0, 0.0], [-0.4, 0.4, 0.0], [-0.4, -0.3, 0.0]])
    assert LinkTracker(SceneModel.of_plan(plan)).errors(1.0, place) == pytest.approx([0.1, 0.0])
    bare = load(
        file, OWN.replace("own.py:Counting", "cyclic-pursuit"), 'formation.links={"A > B" = "link", "A > C" = 0.5}'
    )
    scene = SceneModel.of_plan(bare.cases()["event"])
    assert LinkTracker(scene).errors(1.0, place) == pytest.approx([BARE, 0.0])


def test_measures_take_the_place_of_errors(file):
    links = 'formation.links={"A > B" = "link", "A > C" = "link"}'
    found = simulate(load(file, 'formation.law="leader-observer"'), cases=["event"])
    measured: CaseMetrics = found.metrics["event"]
    assert measured.has_errors
    assert measured.measures["lag"].unit == "m"
    assert measured.mean["measure_lag_mean"] == measured.measures["lag"].mean
    drawn = figures.all_figures([measured], [*found.traces.values()])
    assert drawn["measures"].axes[0].get_ylabel() == "lag [m]"
    assert {level for row in replay._case(found.traces["event"], 0.5)["e"] for level in row} <= {0, 1, 2}
    bare = load(file, links, 'formation.law={ kind = "enclosing" }').cases()["event"]
    assert law_metrics(bare.law.MEASURES)["measure_gap_mean"].head == "gap (mean) [rad]"
    assert table.main_error([], law_metrics(bare.law.MEASURES)) == "iae"
