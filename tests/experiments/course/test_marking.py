"""Exercises are made from their solutions; whatever the code of a group does, it passes by its criteria alone."""

import json
import signal
from pathlib import Path

import psutil
import pytest

from experiments.course.exercises import CourseError, posed, read_course, write, write_exercises
from tests.commands import GUARD, environment, invoke, started, zenpark
from tests.waiting import until

FILE = """
title = "Two robots meet"
duration_s = 6.0
disturbance.all.position_sigma = 0.0005
[robots.A]
kind = "khepera4"
start = [-0.6, 0.0]
[robots.B]
kind = "khepera4"
start = [0.6, 0.0]
[formation]
law = "meet.py:Meet"
[formation.links]
# blank: # a link
"A - B" = "link"
# end of blank
[[criteria]]
metric = "places.py:Apart"
at_most = 0.9
why = "They are to come nearer."
"""
LAW = """
import os, sys, time
from math import nan
from zenpark import Control, Law

class Meet(Law, frozen=True):
    def step(self, view, memory):
        x = 0.0
        for each in view.neighbours:
            # blank: ...
            x = 0.2 * (each.position[0] - view.position[0])
            # end of blank
        return Control(velocity=(x, 0.0, nan))
"""
METRIC = """
import numpy as np
from zenpark import Metric

class Apart(Metric, frozen=True):
    label, unit, per = "Apart", "m", "case"

    def of(self, trace, shared):
        return np.ptp(trace.true_position[-1, :, 0])
"""
LINE = "x = 0.2 * (each.position[0] - view.position[0])"
# What stands in the law instead of the solution, and words of its failure
TROUBLES = {
    "exits": ("sys.exit(0)", "the law Meet failed: SystemExit: 0 (meet.py:11)"),
    "ends": ("os._exit(0)", "ends the process: os._exit(0) (meet.py:11)"),
    "ends-late": ("view.time > 3.0 and os._exit(0)", "ends the process: os._exit(0) (meet.py:11)"),
    "is-killed": ("os.kill(os.getpid(), 9)", "its process was ended by SIGKILL"),
    "loops": ("\n            while True: pass", "took more than "),
    "computes": ("sum(range(10**12))", "took more than "),
    "prints": ("print('x' * 10**8)", "File too large"),
    "writes": ("open('big', 'wb').write(bytes(10**8))", "File too large"),
    "fills": ("bytearray(10**11)", "the law Meet failed: MemoryError"),
    "boasts": ('print(\'{"met": 1, "of": 1}\'); os._exit(0)', "ends the process"),
    "raises": ("1 / 0", "the law Meet failed: ZeroDivisionError: division by zero (meet.py:11)"),
    "stands": ("x = 0.0", "Apart [m] in default is 1.20 for 2 of 2 seeds"),
    "flees": ("x = view.position[0] - each.position[0]", "the law drives the robots apart"),
}


@pytest.fixture
def course(tmp_path):
    folder = tmp_path / "course"
    write({"meet.toml": FILE, "meet.py": LAW, "places.py": METRIC}, folder)
    return folder


def marked(course: Path, *words: object, code: int) -> tuple[dict[str, dict], str]:
    """Marks by group of the only exercise, and what was printed on standard error."""
    done = zenpark("mark", *words, "--from", course, "--seeds", 2, "--json", code=code)
    return {each["group"]: each for each in json.loads(done.stdout)["marks"]}, done.stderr


def test_exercises_are_made_from_their_solutions(course, tmp_path):
    known = read_course(course)
    (exercise,) = known.exercises.values()
    assert (exercise.laws, exercise.blanks, exercise.criteria) == (("meet.py",), (("formation", "links"),), 1)
    write_exercises(known, tmp_path / "posed")
    assert {file.name for file in (tmp_path / "posed").iterdir()} == {"meet.toml", "meet.py", "places.py"}
    assert (tmp_path / "posed" / "meet.py").read_text("utf-8") == posed(LAW)
    assert LINE not in posed(LAW)
    assert "            ...\n        return" in posed(LAW)
    assert posed(posed(FILE)) == posed(FILE)
    with pytest.raises(CourseError, match="is there already; name another folder"):
        write_exercises(known, tmp_path / "posed")
    with pytest.raises(CourseError, match="holds no exercise"):
        read_course(tmp_path / "posed")


def test_blanks_alone_are_taken(course):
    (exercise,) = read_course(course).exercises.values()
    mine = posed(FILE).replace("at_most = 0.9", "at_most = 9.0").replace("# a link", '"B - A" = "link"')
    assert exercise.filled(mine, "meet.toml") == ['"formation"."links"."B - A"="link"']
    with pytest.raises(CourseError, match="give a number, a text, a list or a table"):
        exercise.filled(posed(FILE).replace("# a link", '"B - A" = 2026-01-01'), "meet.toml")


@pytest.mark.slow
def test_trouble_is_no_pass(course, tmp_path):
    groups = tmp_path / "groups"
    for name, (instead, _) in TROUBLES.items():
        write({"meet.toml": FILE, "meet.py": LAW.replace(LINE, instead)}, groups / name)
    found, said = marked(course, *sorted(groups.iterdir()), "--limit", 5, code=1)
    assert found["(solution)"]["met"] == 1
    assert {name: each["met"] for name, each in found.items() if each["met"]} == {"(solution)": 1}
    for name, (_, words) in TROUBLES.items():
        assert words in " ".join(found[name]["words"]), name
        assert f"{name} meet: " in said
        assert str(tmp_path) not in " ".join(found[name]["words"])


@pytest.mark.slow
def test_groups_hand_in_what_they_like(course, tmp_path):
    groups = tmp_path / "groups"
    write({"meet.toml": FILE, "meet.py": LAW}, groups / "right")
    write({}, groups / "nothing")
    write({"meet.toml": "no toml", "meet.py": LAW}, groups / "spoilt")
    write({"meet.toml": posed(FILE).replace("0.9", "9.0"), "meet.py": posed(LAW)}, groups / "cheats")
    found, _ = marked(course, *groups.iterdir(), code=1)
    assert {name: (each["met"], each["of"]) for name, each in found.items()} == {
        "(solution)": (1, 1), "right": (1, 1), "nothing": (0, 0), "spoilt": (0, 1), "cheats": (0, 1),
    }  # fmt: skip
    assert found["spoilt"]["words"][0].startswith("meet.toml:1")
    table = zenpark("mark", groups / "right", "--from", course, "--seed", 5).stdout.splitlines()
    assert [line.split() for line in table[1:3]] == [["(solution)", "1/1", "1/1"], ["right", "1/1", "1/1"]]
    assert table[3] == "seeds 5 to 7; the same again with --seed 5"


def test_wrong_calls_are_refused(course, tmp_path):
    for words, said in {
        (course / "none",): "none is no folder; give one for each group",
        (course, course): "two groups are named course; give their folders other names",
        (course, "--only", "met"): "no exercise 'met'; did you mean 'meet'?",
    }.items():
        assert said in str(invoke("mark", *words, "--from", course, code=1).exception)
    assert "holds no exercise" in str(invoke("course", tmp_path / "new", "--from", tmp_path, code=1).exception)


FORKS = "(os.fork() or open('begun', 'x'), time.sleep(600))"  # a law that starts a child


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_marking_that_ends_leaves_no_process(course, tmp_path, number):
    write({"meet.toml": FILE, "meet.py": LAW.replace(LINE, FORKS)}, tmp_path / "sleeps")
    words = ("mark", tmp_path / "sleeps", "--from", course, "--seeds", 1)
    with started(*GUARD, *words, env=environment(TMPDIR=str(tmp_path))) as marking:
        until(lambda: list(tmp_path.glob("zenpark-mark-*/*/begun")), "the law sleeps")
        processes = psutil.Process(marking.pid).children(recursive=True)
        assert len(processes) >= 3  # guard, law and its child
        marking.send_signal(number)
        marking.wait()
        until(lambda: not any(map(psutil.Process.is_running, processes)), "all are gone")
