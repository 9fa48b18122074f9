"""Plug-ins in a Python file beside an experiment: adopted where it is read, loaded by digest, and nowhere else."""

import os
import re
import shutil

import msgspec
import pytest

from agents.plugins import files, registry
from experiments.check.check import check
from experiments.file.choices import plugin_files
from experiments.file.document import DocumentError, case_document, load, received, write_json
from experiments.metrics.criteria import judge
from experiments.recording import bundle
from experiments.recording.reader import RecordingError
from experiments.report.tables import summary_table
from experiments.run import reopen, simulate
from experiments.sweep import runs
from tests.commands import ROOT, invoke
from tests.docs.test_python import BLOCK, PAGE

TASK = """
title = "Two robots meet"
duration_s = 2.0
[robots]
A = { kind = "khepera4", start = [-0.5, 0.0] }
B = { kind = "khepera4", start = [0.5, 0.0] }
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


def test_law_beside_the_experiment_moves_robots(task):
    read = load(task)
    slow, fast = (read.cases()[name].law for name in ("slow", "fast"))
    assert (slow.gain, fast.gain, type(slow)) == (0.1, 0.2, type(fast))
    assert load(task, "formation.law.gain=0.3").experiment.formation.law["gain"] == 0.3
    metrics = simulate(read).metrics
    assert 0.0 < metrics["fast"].mean["iae"] < metrics["slow"].mean["iae"]
    # the law is in the subset that is compiled
    assert [each for each in check(read) if each.severity == "error" or "compiled" in each.message] == []
    (task.parent / "solutions").mkdir()
    shutil.copy(task.parent / "meet.py", task.parent / "solutions")
    below = load(task, "formation.law=solutions/meet.py:Meet")
    assert simulate(below, cases=["slow"]).metrics["slow"] == metrics["slow"]


LAW, KIND = 'law = "meet.py:Meet"', 'kind = "khepera4"'
HOSTS = '[hosts.lab1]\naddress = "lab1"\nrobots = ["A"]\n'


@pytest.mark.parametrize(
    ("old", "new", "place", "parts"),
    [
        (LAW, 'law = "met.py:Meet"', "8:7", ["cannot be read (No such file", "files beside the experiment: meet.py"]),
        (LAW, 'law = "../lesson/meet.py:Meet"', "8:7", ["leads out of the folder", "beside the experiment file"]),
        (LAW, 'law = "meet.py:Met"', "8:7", ["it has no Met, only Meet", "mend that file"]),
        (LAW, 'law = "/etc/meet.py:Meet"', "8:7", ["no '/etc/meet.py:Meet' among the laws"]),
        (LAW, 'law = "pipe.py:Meet"', "8:7", ["pipe.py is no file"]),
        (KIND, 'kind = "none.py:BARROW"', "5:14", ["cannot be named by its file", "plugins.md#a-kind-of-robot"]),
        ("gain = 0.2", "gian = 0.2", "13:", ["unknown parameter 'gian' of 'meet.py:Meet'"]),
        ("[cases.slow]\n", f"{HOSTS}[cases.slow]\n", "", ["is a file of this machine"]),
    ],
)
def test_wrong_choice_names_place_and_remedy(task, old, new, place, parts):
    os.mkfifo(task.parent / "pipe.py")
    task.write_text(TASK.replace(old, new, 1), "utf-8")
    text = refused_text(task)
    assert f"{task}:{place}" in text
    assert [part for part in parts if part not in text] == []
    assert "@" not in text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def pull(", "def pull", "(meet.py, line 12)"),
        ("    gain: Positive = 0.1", "    gain: Positive = gain", "name 'gain' is not defined, line 10"),
        ("Meet(Gradient, frozen=True)", "Meet", "inherits from zenpark.Law"),
        ("", "", "others may write to it"),
    ],
)
def test_unsafe_or_broken_file_is_not_loaded(task, old, new, message):
    file = task.parent / "meet.py"
    file.write_text(MEET.replace(old, new) if old else MEET, "utf-8")
    file.chmod(0o644 if old else 0o666)
    assert message in refused_text(task)


def test_changed_file_is_another_plug_in(task):
    cases = [load(task).cases()["slow"]]
    (task.parent / "meet.py").write_text(MEET.replace("0.1", "0.4"), "utf-8")
    cases.append(load(task).cases()["slow"])
    assert [case.law.gain for case in cases] == [0.1, 0.4]
    assert len({runs.digest(case) for case in cases}) == 2
    assert len({runs.code_of(case) for case in cases}) == 2
    (task.parent / "meet.py").write_text(MEET.replace("0.1", "0.5"), "utf-8")
    choice, copy = files.adopt("meet.py:Meet", task.parent)
    copy.write_text(MEET, "utf-8")  # the copy in the cache
    with pytest.raises(registry.PluginError, match="has not read it"):
        registry.struct(registry.LAWS, choice)


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


@pytest.mark.slow
def test_bundle_runs_code_by_agreement_alone(task, tmp_path, monkeypatch):
    out, archive = tmp_path / "run", tmp_path / "run.zip"
    invoke("run", task, "--virtual", "--no-report", "--out", out)
    bundle.write(out, archive, [*load(task).cases().values()])
    monkeypatch.chdir(tmp_path)
    refusal = invoke("run", archive, "--no-report", code=1).exception
    assert (type(refusal), "meet.py" in str(refusal)) == (DocumentError, True)
    invoke("run", archive, "--no-report", "--yes")


def with_criterion(task, metric, **criterion):
    shutil.copy(ROOT / "docs" / "course" / "measures.py", task.parent)
    lines = [f"{key} = {value!r}" for key, value in {"metric": metric, **criterion}.items()]
    task.write_text("\n".join([TASK, "[[criteria]]", *lines]), "utf-8")
    return task


@pytest.mark.parametrize(
    ("metric", "of", "about"),
    [
        ("measures.py:Spread", {}, 0.83),
        ("measures.py:Way", {"of": "A"}, 0.028),
        ("measures.py:Way", {"of": "mean"}, 0.103),
        ("measures.py:Way", {"of": "worst"}, 0.177),
        ("measures.py:Unserved", {}, None),  # it fails: the law has no tasks
    ],
)
def test_criterion_names_a_metric_in_a_file(task, metric, of, about):
    uneven = 'formation.links={ "A > B" = { offset = [0.4, 0.0] }, "B > A" = { offset = [-0.8, 0.0] } }'
    read = load(with_criterion(task, metric, **of, at_most=1.0), uneven)
    (only,) = judge([*simulate(read, cases=["fast"]).metrics.values()])
    assert only.passed == (about is not None)
    assert about is None or only.values[1] == pytest.approx(about, abs=0.01)
    assert "@" not in only.what


def test_run_keeps_the_metrics_of_its_criteria(task, tmp_path):
    with_criterion(task, "measures.py:Spread", at_most=1.0)
    out = tmp_path / "run"
    out.mkdir()  # an empty folder is taken
    output = invoke("run", task, "--virtual", "--no-report", "--out", out).stdout
    (shown,) = re.findall(r"^ +fast: f .*, Spread (0\.\d+) m, .*$", output, re.MULTILINE)
    assert (out / "measures.py").is_file()
    assert "measures.py:Spread" in (out / "metrics.csv").read_text("utf-8").partition("\n")[0]
    for case in msgspec.json.decode((out / "metrics.json").read_bytes()):
        (judged,) = case["judged"]
        assert (judged["what"], judged["passed"]) == (f"Spread [m] in {case['case']}", True)
        assert judged["value"] == case["mean"]["measures.py:Spread"]
    again = reopen(out)
    assert again.summary()["passed"] is True
    (row,) = [row for row in summary_table([again.metrics["fast"]]).rows if row.cells[0] == "Spread [m] of the case"]
    assert float(row.cells[1]) == pytest.approx(float(shown), rel=1e-2)


def test_all_other_choices_may_be_files(task):
    blocks = [each for each in BLOCK.findall(PAGE) if re.search(r"\((Trigger|Predictor|Planner), frozen", each)]
    (task.parent / "others.py").write_text("\n".join(blocks), "utf-8")
    top = 'trigger = { kind = "others.py:SendEvery", metres = 0.05 }\nprediction = "others.py:Still"\n'
    leader = '[robots.L]\nkind = "crazyflie"\nstart = [1.2, 0.0]\nhover = 0.5\n'
    leg = '[[timeline]]\nat_s = 0.0\nrobot = "L"\nplan = "others.py:Lift"\n'
    text = f'{top}avoidance = "others.py:SlowDown"\n{TASK}{leader}{leg}'
    task.write_text(text.replace("[formation.links]", '[formation.links]\n"L > A" = { offset = [-1.7, 0.0] }'), "utf-8")
    run = simulate(load(task), cases=["fast"])
    (leading,) = [robot for robot in run.metrics["fast"].robots if robot.robot == "L"]
    assert run.traces["fast"].true_position[-1, 2, 2] > 0.6
    assert 0 < leading.messages < 10
