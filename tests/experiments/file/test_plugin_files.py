"""Plug-ins in a Python file beside an experiment: adopted where it is read, loaded by digest, and nowhere else."""

import os
import re
import shutil
import sys

import msgspec
import pytest

from agents.plugins import files, registry
from experiments.check.check import check
from experiments.file.document import DocumentError, case_document, load, loads, received, write_json
from experiments.file.structure import plugin_files
from experiments.metrics.criteria import judge
from experiments.recording import bundle
from experiments.recording.reader import RecordingError
from experiments.report.tables import summary_table
from experiments.run import reopen, simulate
from experiments.sweep import runs
from tools.main import main

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


def refused(file, *changes):
    with pytest.raises(DocumentError) as caught:
        load(file, *changes)
    return str(caught.value)


def call(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["zenpark", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_a_law_beside_the_experiment_moves_robots(task):
    read = load(task)
    laws = {name: plan.law for name, plan in read.cases().items()}
    assert {name: law.gain for name, law in laws.items()} == {"slow": 0.1, "fast": 0.2}
    assert type(laws["slow"]) is type(laws["fast"])
    assert load(task, "formation.law.gain=0.3").experiment.formation.law["gain"] == 0.3
    iae = {name: case.mean["iae"] for name, case in simulate(read).metrics.items()}
    assert 0.0 < iae["fast"] < iae["slow"]
    assert not [each for each in check(read) if each.severity == "error"]


def test_a_file_may_lie_in_a_folder_below(task):
    (task.parent / "solutions").mkdir()
    shutil.copy(task.parent / "meet.py", task.parent / "solutions")
    changed = load(task, "formation.law=solutions/meet.py:Meet")
    assert simulate(changed, cases=["slow"]).metrics == simulate(load(task), cases=["slow"]).metrics


@pytest.mark.parametrize(
    ("law", "message", "hint"),
    [
        ("met.py:Meet", "cannot be read (No such file", "files beside the experiment: meet.py"),
        ("../lesson/meet.py:Meet", "leads out of the folder", "beside the experiment file"),
        ("meet.py:Met", "it has no Met, only Meet", "mend that file"),
        ("/etc/meet.py:Meet", "no '/etc/meet.py:Meet' among the laws", ""),
    ],
)
def test_a_wrong_choice_names_place_and_remedy(task, law, message, hint):
    task.write_text(TASK.replace('law = "meet.py:Meet"', f'law = "{law}"'), "utf-8")
    text = refused(task)
    assert f"{task}:11:7: " in text
    assert message in text
    assert hint in text
    assert "@" not in text


@pytest.mark.parametrize("kind", ["meet.py:Meet", "none.py:BARROW"])
def test_kind_in_a_file_is_refused(task, kind):
    task.write_text(TASK.replace('kind = "khepera4"', f'kind = "{kind}"', 1), "utf-8")
    text = refused(task)
    assert f"{task}:5:8: " in text
    assert "a kind cannot be named by its file" in text
    assert "docs/plugins.md#a-kind-of-robot" in text


def test_a_pipe_is_not_waited_for(task):
    os.mkfifo(task.parent / "pipe.py")
    task.write_text(TASK.replace('law = "meet.py:Meet"', 'law = "pipe.py:Meet"'), "utf-8")
    assert "pipe.py is no file" in refused(task)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def pull(", "def pull", "(meet.py, line 12)"),
        ("    gain: Positive = 0.1", "    gain: Positive = gain", "name 'gain' is not defined, line 10"),
        ("Meet(Gradient, frozen=True)", "Meet", "inherits from zenpark.Law"),
    ],
)
def test_a_broken_file_is_named_with_its_line(task, old, new, message):
    (task.parent / "meet.py").write_text(MEET.replace(old, new), "utf-8")
    assert message in refused(task)


def test_unknown_parameters_are_found(task):
    task.write_text(TASK.replace("gain = 0.2", "gian = 0.2"), "utf-8")
    assert "unknown parameter 'gian' of 'meet.py:Meet'" in refused(task)


def test_what_others_may_write_is_not_loaded(task):
    (task.parent / "meet.py").chmod(0o666)
    assert "others may write to it" in refused(task)


def test_a_changed_file_is_another_plug_in(task):
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
    assert (
        next(iter(received(case_document(case).decode(), "a pipe").cases().values())).experiment.formation
        == case.experiment.formation
    )
    assert {file.name for file in plugin_files(again)} >= {"meet.py"}
    result = msgspec.json.decode(runs.fly(write_json(case), [1], runs.code_of(case)), type=runs.WorkResult)
    assert [run.seed for run in result.runs] == [1]


@pytest.mark.slow
def test_another_machine_loads_nothing(task, tmp_path, monkeypatch):
    out = tmp_path / "run"
    assert call(monkeypatch, "run", task, "--virtual", "--no-report", "--out", out) == 0
    assert (out / "meet.py").read_text("utf-8") == MEET
    case = load(task).cases()["fast"]
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "elsewhere"))
    with pytest.raises(registry.PluginError, match="has not read it on this machine"):
        _ = case.changed().law
    with pytest.raises(DocumentError, match="has not read it"):
        received(case_document(case).decode(), "the network")
    with pytest.raises(RecordingError, match=r"meet\.py.*zenpark check"):
        reopen(out)
    assert call(monkeypatch, "check", out / "experiment.toml") == 0
    assert set(reopen(out).metrics) == {"slow", "fast"}


def test_a_copy_that_was_changed_is_not_loaded(task):
    choice, copy = files.adopt("meet.py:Meet", task.parent)
    copy.write_text(MEET + "\n", "utf-8")
    with pytest.raises(registry.PluginError, match="has not read it"):
        registry.struct(registry.LAWS, choice)


def test_hosts_do_not_load_it(task):
    task.write_text(TASK + '[hosts.lab1]\naddress = "lab1"\nrobots = ["A"]\n', "utf-8")
    assert "is a file of this machine" in refused(task)


@pytest.mark.slow
def test_a_bundle_runs_code_by_agreement_alone(task, tmp_path, monkeypatch, capsys):
    out, archive = tmp_path / "run", tmp_path / "run.zip"
    assert call(monkeypatch, "run", task, "--virtual", "--no-report", "--out", out) == 0
    bundle.write(out, archive, [*load(task).cases().values()])
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "run", archive, "--no-report") == 2
    assert "meet.py" in capsys.readouterr().err
    assert call(monkeypatch, "run", archive, "--no-report", "--yes") == 0


def test_a_law_in_the_subset_is_compiled(task):
    pytest.importorskip("numba")
    notes = [each for each in check(load(task), ["slow"]) if "compiled" in each.message]
    assert notes == []


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


def judged(task, **criterion):
    lines = [f"{key} = {value!r}" for key, value in criterion.items()]
    task.write_text("\n".join([TASK, "[[criteria]]", *lines]), "utf-8")
    return judge([*simulate(load(task), cases=["fast"]).metrics.values()])


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
def test_a_criterion_names_a_metric_in_a_file(spread, criterion, low, high):
    (only,) = judged(spread, **criterion, at_most=high)
    assert low < only.values[1] < high
    assert only.passed
    assert "@" not in only.what


def test_an_unusable_metric_in_a_file_is_named(spread):
    assert "it has no Spred, only" in refused_criterion(spread, "spread.py:Spred")
    assert "cannot be read" in refused_criterion(spread, "sprad.py:Spread")
    (only,) = judged(spread, metric="spread.py:Broken", at_most=1.0)
    assert only.passed is False


def refused_criterion(task, metric):
    task.write_text(f'{TASK}[[criteria]]\nmetric = "{metric}"\nat_most = 1.0\n', "utf-8")
    return refused(task)


def test_a_run_keeps_the_metrics_of_its_criteria(spread, tmp_path, monkeypatch, capsys):
    spread.write_text(TASK + '[[criteria]]\nmetric = "spread.py:Spread"\nat_most = 1.0\n', "utf-8")
    out = tmp_path / "run"
    out.mkdir()  # an empty folder is taken
    assert call(monkeypatch, "run", spread, "--virtual", "--no-report", "--out", out) == 0
    (shown,) = re.findall(r"^ +fast: f .*, Spread (0\.\d+) m, .*$", capsys.readouterr().out, re.MULTILINE)
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


def test_explain_says_that_files_are_not_explained(task, monkeypatch, capsys):
    monkeypatch.chdir(task.parent)
    assert call(monkeypatch, "explain", "meet.py:Meet") == 2
    assert "their parameters stand in the file" in capsys.readouterr().err
