"""Plug-ins in a Python file beside an experiment: adopted where it is read, loaded by digest, and nowhere else."""

import os
import re
import shutil

import msgspec
import pytest

from agents.plugins import files, registry
from experiments.check.check import check
from experiments.file.choices import plugin_files
from experiments.file.document import DocumentError, case_document, load, loads, received, write_json
from experiments.metrics.criteria import judge
from experiments.recording import bundle
from experiments.recording.reader import RecordingError
from experiments.report.tables import summary_table
from experiments.run import reopen, simulate
from experiments.sweep import runs
from tests.commands import invoke

TASK = """
title = "Two robots meet"
duration_s = 2.0
[robots.A]
kind = "khepera4"
start = [-0.5, 0.0]
[robots.B]
kind = "khepera4"
start = [0.5, 0.0]
[formation]
law = "meet.py:Meet"
[formation.links]
"A - B" = { offset = [0.4, 0.0] }
[cases.slow]
[cases.fast]
formation.law = { kind = "meet.py:Meet", gain = 0.2 }
"""
MEET = """
from agents.formation.link import Link
from agents.plugins.law import Need
from agents.plugins.laws import Gradient
from agents.vectors import Positive, Vector


class Meet(Gradient, frozen=True):
    NEEDS = "relative"
    gain: Positive = 0.1

    def pull(self, apart: Vector, link: Link) -> Vector:
        k, wanted = self.gain, link.relative
        return k * (wanted[0] - apart[0]), k * (wanted[1] - apart[1]), 0.0

    def error(self, apart: Vector, link: Link) -> float:
        return abs(apart[0] - link.relative[0])
"""


@pytest.fixture
def task(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "cache"))
    file = tmp_path / "lesson" / "task.toml"
    file.parent.mkdir()
    file.write_text(TASK, "utf-8")
    (file.parent / "meet.py").write_text(MEET, "utf-8")
    return file


def refused_text(file, *changes):
    with pytest.raises(DocumentError) as caught:
        load(file, *changes)
    return str(caught.value)


def refused_with(task, old, new):
    """The experiment with another text, refused."""
    task.write_text(TASK.replace(old, new, 1), "utf-8")
    return refused_text(task)


def test_law_beside_the_experiment_moves_robots(task):
    read = load(task)
    laws = {name: plan.law for name, plan in read.cases().items()}
    assert {name: law.gain for name, law in laws.items()} == {"slow": 0.1, "fast": 0.2}
    assert type(laws["slow"]) is type(laws["fast"])
    assert load(task, "formation.law.gain=0.3").experiment.formation.law["gain"] == 0.3
    metrics = simulate(read).metrics
    assert 0.0 < metrics["fast"].mean["iae"] < metrics["slow"].mean["iae"]
    assert not [each for each in check(read) if each.severity == "error"]
    (task.parent / "solutions").mkdir()
    shutil.copy(task.parent / "meet.py", task.parent / "solutions")
    below = load(task, "formation.law=solutions/meet.py:Meet")
    assert simulate(below, cases=["slow"]).metrics["slow"] == metrics["slow"]


@pytest.mark.parametrize(
    ("law", "message", "hint"),
    [
        ("met.py:Meet", "cannot be read (No such file", "files beside the experiment: meet.py"),
        ("../lesson/meet.py:Meet", "leads out of the folder", "beside the experiment file"),
        ("meet.py:Met", "it has no Met, only Meet", "mend that file"),
        ("/etc/meet.py:Meet", "no '/etc/meet.py:Meet' among the laws", ""),
    ],
)
def test_wrong_choice_names_place_and_remedy(task, law, message, hint):
    text = refused_with(task, 'law = "meet.py:Meet"', f'law = "{law}"')
    assert f"{task}:11:7: " in text
    assert message in text
    assert hint in text
    assert "@" not in text


@pytest.mark.parametrize("kind", ["meet.py:Meet", "none.py:BARROW"])
def test_kind_in_a_file_is_refused(task, kind):
    text = refused_with(task, 'kind = "khepera4"', f'kind = "{kind}"')
    assert f"{task}:5:8: " in text
    assert "a kind cannot be named by its file" in text
    assert "docs/plugins.md#a-kind-of-robot" in text


def test_pipe_is_not_waited_for(task):
    os.mkfifo(task.parent / "pipe.py")
    assert "pipe.py is no file" in refused_with(task, 'law = "meet.py:Meet"', 'law = "pipe.py:Meet"')


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def pull(", "def pull", "(meet.py, line 12)"),
        ("    gain: Positive = 0.1", "    gain: Positive = gain", "name 'gain' is not defined, line 10"),
        ("Meet(Gradient, frozen=True)", "Meet", "inherits from zenpark.Law"),
    ],
)
def test_broken_file_is_named_with_its_line(task, old, new, message):
    (task.parent / "meet.py").write_text(MEET.replace(old, new), "utf-8")
    assert message in refused_text(task)


def test_unknown_parameters_are_found(task):
    assert "unknown parameter 'gian' of 'meet.py:Meet'" in refused_with(task, "gain = 0.2", "gian = 0.2")


def test_file_that_others_may_write_is_not_loaded(task):
    (task.parent / "meet.py").chmod(0o666)
    assert "others may write to it" in refused_text(task)


def test_changed_file_is_another_plug_in(task):
    before = load(task)
    (task.parent / "meet.py").write_text(MEET.replace("0.1", "0.4"), "utf-8")
    after = load(task)
    cases = before.cases()["slow"], after.cases()["slow"]
    assert [case.law.gain for case in cases] == [0.1, 0.4]
    assert len({runs.digest(case) for case in cases}) == 2
    assert len({runs.code_of(case) for case in cases}) == 2


def test_every_process_loads_it_by_its_digest(task):
    case = load(task).cases()["fast"]
    written = task.parent.parent / "case.json"
    written.write_bytes(write_json(case))
    again = load(written).plan
    assert again == case
    (there,) = received(case_document(case).decode(), "a pipe").cases().values()
    assert there.experiment.formation == case.experiment.formation
    assert {file.name for file in plugin_files(again)} >= {"meet.py"}
    result = msgspec.json.decode(runs.fly(write_json(case), [1], runs.code_of(case)), type=runs.WorkResult)
    assert [run.seed for run in result.runs] == [1]


@pytest.mark.slow
def test_another_machine_loads_nothing(task, tmp_path, monkeypatch):
    out = tmp_path / "run"
    invoke("run", task, "--virtual", "--no-report", "--out", out)
    assert (out / "meet.py").read_text("utf-8") == MEET
    case = load(task).cases()["fast"]
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "elsewhere"))
    with pytest.raises(registry.PluginError, match="has not read it on this machine"):
        _ = case.changed().law
    with pytest.raises(DocumentError, match="has not read it"):
        received(case_document(case).decode(), "the network")
    with pytest.raises(RecordingError, match=r"meet\.py.*zenpark check"):
        reopen(out)
    invoke("check", out / "experiment.toml")
    assert set(reopen(out).metrics) == {"slow", "fast"}


def test_copy_that_was_changed_is_not_loaded(task):
    choice, copy = files.adopt("meet.py:Meet", task.parent)
    copy.write_text(MEET + "\n", "utf-8")
    with pytest.raises(registry.PluginError, match="has not read it"):
        registry.struct(registry.LAWS, choice)


def test_hosts_do_not_load_it(task):
    hosts = '[hosts.lab1]\naddress = "lab1"\nrobots = ["A"]\n'
    assert "is a file of this machine" in refused_with(task, "[cases.slow]\n", f"{hosts}[cases.slow]\n")


@pytest.mark.slow
def test_bundle_runs_code_by_agreement_alone(task, tmp_path, monkeypatch):
    out, archive = tmp_path / "run", tmp_path / "run.zip"
    invoke("run", task, "--virtual", "--no-report", "--out", out)
    bundle.write(out, archive, [*load(task).cases().values()])
    monkeypatch.chdir(tmp_path)
    refusal = invoke("run", archive, "--no-report", code=1).exception
    assert isinstance(refusal, DocumentError)
    assert "meet.py" in str(refusal)
    invoke("run", archive, "--no-report", "--yes")


def test_law_in_the_subset_is_compiled(task):
    pytest.importorskip("numba")
    assert not [each for each in check(load(task), ["slow"]) if "compiled" in each.message]


def test_text_in_no_file_looks_here(task, monkeypatch):
    monkeypatch.chdir(task.parent)
    assert loads(TASK).cases().keys() == {"slow", "fast"}


SPREAD = """
import numpy as np

from zenpark import Metric

class Spread(Metric, frozen=True):
    label = "Spread"
    unit = "m"
    per = "case"

    def of(self, trace, shared):
        return np.ptp(trace.true_position[-1], axis=0).max()

class Last(Metric, frozen=True):
    label = "x in the end"
    unit = "m"

    def of(self, trace, shared):
        return trace.true_position[-1, :, 0]

class Broken(Metric, frozen=True):
    unit = "m"
"""


def with_criterion(task, **criterion):
    lines = [f"{key} = {value!r}" for key, value in criterion.items()]
    task.write_text("\n".join([TASK, "[[criteria]]", *lines]), "utf-8")
    return task


def judged(task, **criterion):
    return judge([*simulate(load(with_criterion(task, **criterion)), cases=["fast"]).metrics.values()])


@pytest.fixture
def spread(task):
    (task.parent / "spread.py").write_text(SPREAD, "utf-8")
    return task


@pytest.mark.parametrize(
    ("criterion", "low", "high"),
    [
        ({"metric": "spread.py:Spread"}, 0.0, 1.0),
        ({"metric": "spread.py:Last", "of": "B"}, 0.0, 0.5),
        ({"metric": "spread.py:Last", "of": "worst"}, 0.0, 0.5),
    ],
)
def test_criterion_names_a_metric_in_a_file(spread, criterion, low, high):
    (only,) = judged(spread, **criterion, at_most=high)
    assert low < only.values[1] < high
    assert only.passed
    assert "@" not in only.what


def test_unusable_metric_in_a_file_is_named(spread):
    for metric, message in (("spread.py:Spred", "it has no Spred, only"), ("sprad.py:Spread", "cannot be read")):
        assert message in refused_text(with_criterion(spread, metric=metric, at_most=1.0))
    (only,) = judged(spread, metric="spread.py:Broken", at_most=1.0)
    assert only.passed is False


def test_run_keeps_the_metrics_of_its_criteria(spread, tmp_path):
    with_criterion(spread, metric="spread.py:Spread", at_most=1.0)
    out = tmp_path / "run"
    out.mkdir()  # an empty folder is taken
    output = invoke("run", spread, "--virtual", "--no-report", "--out", out).stdout
    (shown,) = re.findall(r"^ +fast: f .*, Spread (0\.\d+) m, .*$", output, re.MULTILINE)
    assert (out / "spread.py").is_file()
    assert "spread.py:Spread" in (out / "metrics.csv").read_text("utf-8").partition("\n")[0]
    for case in msgspec.json.decode((out / "metrics.json").read_bytes()):
        (judged,) = case["judged"]
        assert judged["what"] == f"Spread [m] in {case['case']}"
        assert judged["value"] == case["mean"]["spread.py:Spread"]
        assert judged["passed"] is True
    again = reopen(out)
    assert again.summary()["passed"] is True
    (row,) = [row for row in summary_table([again.metrics["fast"]]).rows if row.cells[0] == "Spread [m] of the case"]
    assert float(row.cells[1]) == pytest.approx(float(shown), rel=1e-2)


OTHERS = """
from math import nan

from zenpark import Avoidance, Planner, Predictor, Trigger, distance

class Every(Trigger, frozen=True):
    metres: float = 0.1

    def fires(self, view):
        return distance(view.position, view.last.position) > self.metres

class Still(Predictor, frozen=True):
    def position(self, pose, age):
        return pose.position

    def velocity(self, pose, age):
        return 0.0, 0.0, 0.0

class Aside(Planner, frozen=True):
    def target(self, elapsed, anchor, heading):
        return anchor[0], anchor[1] + 0.05 * elapsed, anchor[2], nan

    def speed(self):
        return 0.05

class Bold(Avoidance, frozen=True):
    def deviate(self, goal, own, near, period):
        return goal
"""


def test_all_other_choices_may_be_files(task):
    (task.parent / "others.py").write_text(OTHERS, "utf-8")
    top = 'trigger = { kind = "others.py:Every", metres = 0.05 }\nprediction = "others.py:Still"\n'
    leader = '[robots.L]\nkind = "khepera4"\nstart = [1.2, 0.0]\n'
    leg = '[[timeline]]\nat_s = 0.0\nrobot = "L"\nplan = "others.py:Aside"\n'
    text = f'{top}avoidance = "others.py:Bold"\n{TASK}{leader}{leg}'
    task.write_text(text.replace("[formation.links]", '[formation.links]\n"L > A" = { offset = [-1.7, 0.0] }'), "utf-8")
    run = simulate(load(task), cases=["fast"])
    (leading,) = [robot for robot in run.metrics["fast"].robots if robot.robot == "L"]
    assert run.traces["fast"].true_position[-1, 2, 1] > 0.02
    assert 0 < leading.messages < 10


def test_explain_says_that_files_are_not_explained(task, monkeypatch):
    monkeypatch.chdir(task.parent)
    assert "their parameters stand in the file" in invoke("explain", "meet.py:Meet", code=2).stderr
