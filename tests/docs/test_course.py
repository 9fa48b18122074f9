"""The exercises of the course: a blank does not pass, its solution does; both can be run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from experiments.check.check import check
from experiments.file.document import load
from experiments.metrics.criteria import has_passed, judge
from experiments.run import simulate
from tests.commands import ROOT
from tests.docs.test_commands import commands

COURSE = ROOT / "docs" / "course"
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
    """Criteria that are not met."""
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
