"""The exercises of the course: a blank does not pass, its solution does; both can be run."""

from __future__ import annotations

import re
import shlex
from functools import cache
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


@cache
def solutions() -> dict[str, list[str]]:
    """The `--set` of each solution, by the file of the exercise."""
    found = {}
    for command in commands(COURSE / "solutions" / "README.md"):
        run, file, virtual, *settings = shlex.split(command)
        assert (run, virtual, settings[::2]) == ("run", "--virtual", ["--set"] * (len(settings) // 2))
        found[Path(file).name] = settings[1::2]
    return found


def missed(exercise: Path, *changes: str, seed: int = 1) -> list[str]:
    """Criteria that are not met."""
    judged = judge([*simulate(load(exercise, *changes), seed=seed).metrics.values()])
    assert has_passed(judged) is not None
    return [each.what for each in judged if not each.passed]


def test_there_are_ten_exercises_with_solutions():
    assert [file.name for file in EXERCISES] == [*solutions()]
    assert len(EXERCISES) == 10
    assert not [file for file in COURSE.glob("solutions/*.py") if not (COURSE / file.name).is_file()]


EVERY = pytest.mark.parametrize("exercise", EXERCISES, ids=lambda file: file.stem)


@pytest.mark.slow
@EVERY
def test_a_blank_does_not_pass(exercise):
    assert re.search(r"# fill in|\.\.\.  #", "".join(each.read_text("utf-8") for each in parts(exercise)))
    assert missed(exercise)


@pytest.mark.slow
@EVERY
def test_a_solution_passes(exercise):
    assert missed(exercise, *solutions()[exercise.name]) == []


@pytest.mark.slow
@pytest.mark.parametrize("solved", [pytest.param(False, marks=pytest.mark.nightly), True])
@EVERY
def test_exercises_are_sound(exercise, solved):
    changes = solutions()[exercise.name] if solved else []
    assert not [found for found in check(load(exercise, *changes)) if found.severity == "error"]


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [2, 3])
@EVERY
def test_exercises_hold_for_other_seeds(exercise, seed):
    assert missed(exercise, seed=seed)
    assert missed(exercise, *solutions()[exercise.name], seed=seed) == []


def parts(exercise: Path) -> list[Path]:
    """The file of an exercise, and its law."""
    return [exercise, *COURSE.glob(f"{exercise.stem[:2]}_*.py")]
