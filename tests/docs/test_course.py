"""Exercises of the course are decided rightly, whatever the seed; lessons are notebooks whose claims are true."""

import ast
import json
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from experiments.check.check import check
from experiments.course.exercises import OURS, read_course, write
from experiments.file.document import load
from experiments.run import simulate
from tests.cases import for_each, nightly
from tests.commands import ROOT, python, zenpark

LESSONS = ROOT / "docs" / "tutorials"
NAMES = sorted(path.stem for path in LESSONS.glob("*.py"))
COURSE = read_course(OURS)
# By the kind of an answer and its file: a part of the solution, and what stands there instead
ANSWERS = {
    "wrong": {
        "01_rendezvous.py": ("each.position[0] - x", "x - each.position[0]"),
        "02-consensus-rate.toml": ("KH06 - KH01", "KH01 - KH03"),
        "03-rigidity.toml": ("1.131", "1.55"),
        "04-events.toml": ("threshold = 0.075", "threshold = 0.02"),
        "05-loss.toml": ('= "constant-velocity"', '= "hold"'),
        "06_leader.py": ("(said_x - vx)", "(vx - said_x)"),
        "07_pursuit.py": ("+ sin(self.angle) * y", "- sin(self.angle) * y"),
        "08_flocking.py": ('(each.said["v"][0] - vx)', '(vx - each.said["v"][0])'),
        "09_coverage.py": ("<= dist(place, other)", ">= dist(place, other)"),
        "10-assignment.toml": ("epsilon = 0.25", "epsilon = 3.0"),
    },
    "nearly": {
        "01_rendezvous.py": ("to_x += ", "to_x = "),  # the last neighbour alone
        "02-consensus-rate.toml": ("KH06 - KH01", "KH05 - KH01"),
        "03-rigidity.toml": ("1.131", "1.0"),
        "04-events.toml": ("threshold = 0.075", "threshold = 0.1"),
        "05-loss.toml": ('= "constant-velocity"', '= "velocity"'),
        "06_leader.py": ("self.observer * (said_x - vx)", "(self.observer * said_x - vx)"),
        "07-pursuit.toml": ("angle = 0.507", "angle = 0.45"),
        "08_flocking.py": ('ay += self.align * (each.said["v"][1] - vy)', "pass"),
        "09_coverage.py": ("if all(", "if any("),
        "10-assignment.toml": ("epsilon = 0.25", "epsilon = 0.6"),
    },
    "too fine": {
        "04-events.toml": ("threshold = 0.075", "threshold = 0.055"),
        "10-assignment.toml": ("epsilon = 0.25", "epsilon = 0.05"),
    },
}


def answered(swaps: Mapping[str, tuple[str, str]], folder: Path) -> Path:
    """Folder of a group with the files of these exercises, each solved but for a swap."""
    numbers = {name[:2] for name in swaps}
    texts = {name: text for name, text in COURSE.solved.items() if name[:2] in numbers}
    for name, (solution, instead) in swaps.items():
        assert texts[name].count(solution) == 1
        texts[name] = texts[name].replace(solution, instead)
    write(texts, folder)
    return folder


def test_there_are_ten_exercises():
    assert [name[:2] for name in COURSE.exercises] == [f"{number:02}" for number in range(1, 11)]
    assert sum(len(each.laws) for each in COURSE.exercises.values()) == len([*OURS.glob("*.py")]) - 1  # the metrics


@for_each("exercise", COURSE.exercises)
def test_a_solution_is_quiet(exercise):
    """Neither `check` nor the run of a right solution says anything to worry about."""
    read = load(OURS / f"{exercise}.toml")
    assert [str(found) for found in check(read) if found.severity in {"error", "warning"}] == []
    run = simulate(read, seed=7)
    assert run.summary()["passed"] is True
    assert [event.text for trace in run.traces.values() for event in trace.events if event.kind == "hazard"] == []


def test_a_turned_sign_is_named(tmp_path):
    """A law that drives robots apart has not passed, and its criteria say why."""
    folder = answered({"01_rendezvous.py": ANSWERS["wrong"]["01_rendezvous.py"]}, tmp_path)
    write({"measures.py": COURSE.solved["measures.py"]}, folder)
    file = folder / "01-rendezvous.toml"
    (found,) = [each for each in check(load(file)) if each.severity == "error"]
    assert (found.code, found.where) == ("drives-apart", f"{file}:34:7")
    assert found.message.startswith("the law drives the robots apart: on average 1.87 m from each other at first, 2.5")
    done = zenpark("run", file, "--virtual", "--json", code=1, cwd=tmp_path)
    assert "✗ the law drives the robots apart" in done.stderr
    assert "✗ Not passed. The robots are to line up" in done.stderr
    said = json.loads(done.stdout)
    assert (said["ok"], said["passed"]) == (False, False)


@pytest.mark.slow
@pytest.mark.parametrize(("groups", "seeds"), [(["nearly", "too fine"], 1), nightly([*ANSWERS], 10)])
def test_answers_are_decided_rightly(groups, seeds, tmp_path):
    """The solutions pass, all others fail: whatever the seed, and by the same criteria."""
    folders = [answered(ANSWERS[name], tmp_path / name) for name in groups]
    done = zenpark("mark", *folders, "--seeds", seeds, "--seed", 100, "--json", code=1, timeout_s=600.0)
    found = json.loads(done.stdout)["marks"]
    right = [each["exercise"] for each in found if each["group"] == "(solution)" and each["met"] == each["of"]]
    assert sorted(right) == sorted(COURSE.exercises)
    for group in groups:
        judged = {each["exercise"]: each for each in found if each["group"] == group and each["of"]}
        assert {name[:2] for name in judged} == {name[:2] for name in ANSWERS[group]}
        for each in judged.values():
            assert each["met"] < each["of"]
            assert each["words"]
            counts = [re.search(r"for (\d+) of (\d+) seeds", word) for word in each["words"]]
            assert not [count for count in counts if count is not None and count[1] != count[2]], each["words"]


def cells(lesson):
    """Markdown and code cells, in order."""
    text = (LESSONS / f"{lesson}.py").read_text("utf-8")
    assert text.startswith("# %%")
    parts = re.split(r"^# %%( \[markdown\])?\n", text, flags=re.MULTILINE)[1:]
    return [(bool(mark), body) for mark, body in zip(parts[::2], parts[1::2], strict=True)]


@pytest.mark.parametrize("lesson", NAMES)
def test_a_lesson_is_a_notebook(lesson):
    found = cells(lesson)
    words = [body for is_text, body in found if is_text]
    code = [body for is_text, body in found if not is_text]
    assert all(line.startswith("#") for body in words for line in body.strip().splitlines())
    assert words[0].startswith("# # ")
    trees = [ast.parse(body) for body in code]  # each cell stands alone
    named = {node.id for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert "__file__" not in named  # notebooks have none
    assert sum(isinstance(node, ast.Assert) for tree in trees for node in ast.walk(tree)) >= 20
    for tree in trees:
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
        exec(compile(ast.Module(imports, []), lesson, "exec"), {})


@pytest.mark.nightly
@pytest.mark.parametrize("lesson", NAMES)
def test_what_a_lesson_claims_is_true(lesson, tmp_path):
    done = python("-W", "error", LESSONS / f"{lesson}.py", tmp_path / "figures", cwd=tmp_path, timeout_s=280.0)
    assert done.stderr == ""
    drawn = [*(tmp_path / "figures").glob(f"{lesson}-*.svg")]
    assert len(drawn) >= 3
    assert not [file for file in drawn if "NaN" in file.read_text("utf-8")]
