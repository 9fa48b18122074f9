"""Exercises of the course pass with their solutions alone; lessons are notebooks whose claims are true."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from experiments.check.check import check
from experiments.file.document import load
from experiments.metrics.criteria import has_passed, judge
from experiments.run import simulate
from tests.commands import ROOT, python
from tests.docs.test_pages import commands

COURSE = ROOT / "docs" / "course"
LESSONS = ROOT / "docs" / "tutorials"
NAMES = sorted(path.stem for path in LESSONS.glob("*.py"))
EXERCISES = sorted(COURSE.glob("*.toml"))


def settings() -> dict[str, list[str]]:
    """The `--set` of each solution, by the file of the exercise."""
    found = {}
    for command in commands(COURSE / "solutions" / "README.md"):
        run, file, virtual, *words = shlex.split(command)
        assert (run, virtual, words[::2]) == ("run", "--virtual", ["--set"] * (len(words) // 2))
        found[Path(file).name] = words[1::2]
    return found


SOLUTIONS = settings()


def missed(exercise: Path, *changes: str, seed: int) -> list[str]:
    judged = judge([*simulate(load(exercise, *changes), seed=seed).metrics.values()])
    assert has_passed(judged) is not None
    return [each.what for each in judged if not each.passed]


def test_there_are_ten_exercises_with_solutions():
    assert [file.name for file in EXERCISES] == [*SOLUTIONS]
    assert len(EXERCISES) == 10
    assert not [file for file in COURSE.glob("solutions/*.py") if not (COURSE / file.name).is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (2, 3))])
@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda file: file.stem)
def test_exercise_passes_with_its_solution_alone(exercise, seed):
    parts = [exercise, *COURSE.glob(f"{exercise.stem[:2]}_*.py")]
    assert re.search(r"# fill in|\.\.\.  #", "".join(each.read_text("utf-8") for each in parts))
    assert missed(exercise, seed=seed)
    solution = SOLUTIONS[exercise.name]
    assert missed(exercise, *solution, seed=seed) == []
    assert not [found for found in check(load(exercise, *solution)) if found.severity == "error"]


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
