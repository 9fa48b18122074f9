"""Exercises are made from their solutions; whatever the code of a group does, it passes by its criteria alone."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from agents.plugins.extras import policy
from experiments.course.exercises import OURS, CourseError, posed, read_course, write, write_exercises
from experiments.course.stand_ins import company
from experiments.course.wall import lacking
from experiments.file.document import load
from experiments.run import simulate
from tests.agents.learned import learned_bytes
from tests.commands import GUARD, environment, invoke, python, started, zenpark
from tests.waiting import until

FILE = """
title = "Two robots meet"
duration_s = 6.0
disturbance.all.position_sigma = 0.0005
start.deadline_s = 5.0
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
KNOWING = "KNOWING = {'Plan', 'Course', 'Exercise', 'Company'}\n"  # names of what a law is not to find
# What stands in the law instead of the solution, and words of its failure
TROUBLES = {
    "exits": ("sys.exit(0)", "the law Meet failed: SystemExit: 0 (meet.py:12)"),
    "ends": ("os._exit(0)", "ends the process: os._exit(0) (meet.py:12)"),
    "ends-late": ("view.time > 3.0 and os._exit(0)", "ends the process: os._exit(0) (meet.py:12)"),
    "is-killed": ("os.kill(os.getpid(), 9)", "its process ended, by signal 9"),
    "loops": ("\n            while True: pass", "took more than 2 s (meet.py:13); does a loop there never end?"),
    "computes": ("sum(range(10**12))", "took more than "),
    "fills": ("bytearray(10**11)", "the law Meet failed: MemoryError"),
    "boasts": ('print(\'{"met": 1, "of": 1}\'); os._exit(0)', "ends the process"),
    "raises": ("1 / 0", "the law Meet failed: ZeroDivisionError: division by zero (meet.py:12)"),
    "empty": ("return None", "must give a Control, not nothing: is a `return` missing?"),
    "texts": ("x = 'far'", "must give three numbers as velocity or goal, not ['far', 0.0, nan]"),
    "stands": ("x = 0.0", "Apart [m] in default is 1.20 for 2 of 2 seeds"),
    "flees": ("x = view.position[0] - each.position[0]", "the law drives the robots apart"),
    "answers": ("[os.write(n, bytes(8)) for n in range(3, 30) if os.path.exists(f'/dev/fd/{n}')]", "answers what"),
    "patches": ("import experiments.metrics.criteria as c; c.judge = lambda cases: []", "Apart [m] in default is 1.20"),
    "searches": ("import gc; raise ValueError({type(x).__name__ for x in gc.get_objects()} & KNOWING)", "Error: set()"),
    "talks": ("KNOWING.add(view.robot.name); x = 0.2 * (len(KNOWING) > 5) * (each.position[0] - view.position[0])",
              "Apart [m] in default is 1.20"),
}  # fmt: skip
# Likewise, of laws that meet a wall: how they try, in the folder of the course or on the process that marks
REFUSED = {
    "reads": "open('{course}/meet.py').read()", "deletes": "os.remove('{course}/places.py')",
    "empties": "os.truncate('{course}/places.py', 0)", "hides": "os.chmod('{course}/places.py', 0)",
    "writes": "open('mark.json', 'w').write('passed')", "shares": "open('/dev/shm/places', 'w')",
    "looks": "open('/proc/%d/mem' % os.getppid(), 'r+b')", "kills": "os.kill(os.getppid(), 9)",
    "forks": "os.fork()", "starts": "__import__('subprocess').run(['true'])", "leaves": "os.setsid()",
    "calls": "__import__('socket').socket()",
}  # fmt: skip
HONEST = {
    "computes": "import numpy; x = numpy.float64(0.2) * (numpy.array(each.position) - view.position)[0]",
    "imports": f"import scipy.linalg; {LINE}",
    "prints": f"print(each, file=sys.stderr); {LINE}",
    "waits": f"import threading; it = threading.Thread(target=print); it.start(); it.join(); {LINE}",
}
walled = pytest.mark.skipif(bool(lacking()), reason=f"no wall around {' and '.join(lacking())} here")


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
    table = (("formation",),)
    closed = replace(exercise, blanks=table, solved={"formation": exercise.posed["formation"] | {"gain": 2.0}})
    given = posed(FILE).replace("[formation]", "[formation]\nstiffness = 9.0\ngain = 3.0")
    assert closed.filled(given, "meet.toml") == ['"formation"."gain"=3.0']
    with pytest.raises(CourseError, match="give a number, a text, a list or a table"):
        exercise.filled(posed(FILE).replace("# a link", '"B - A" = 2026-01-01'), "meet.toml")


def handed_in(groups: Path, lines: dict[str, str]) -> list[Path]:
    """Folders of groups, each with a line in the place of the solution's."""
    for name, instead in lines.items():
        write({"meet.toml": FILE, "meet.py": KNOWING + LAW.replace(LINE, instead)}, groups / name)
    return sorted(groups.iterdir())


@pytest.mark.slow
def test_trouble_is_no_pass(course, tmp_path):
    folders = handed_in(tmp_path / "groups", {name: instead for name, (instead, _) in TROUBLES.items()})
    found, said = marked(course, *folders, "--limit", 20, code=1)
    assert found["(solution)"]["met"] == 1
    assert {name: each["met"] for name, each in found.items() if each["met"]} == {"(solution)": 1}
    for name, (_, words) in TROUBLES.items():
        assert words in " ".join(found[name]["words"]), name
        assert f"{name} meet: " in said
        assert str(tmp_path) not in " ".join(found[name]["words"])


@walled
@pytest.mark.slow
def test_a_wall_stands_around_laws(course, tmp_path):
    lines = {name: instead.replace("{course}", str(course)) for name, instead in REFUSED.items()}
    found, said = marked(course, *handed_in(tmp_path / "groups", lines), code=1)
    assert {name: each["met"] for name, each in found.items() if each["met"]} == {"(solution)": 1}
    for name in REFUSED:
        (words,) = found[name]["words"]
        assert words.startswith("the law Meet failed: PermissionError: [Errno "), name
        assert words.endswith("(meet.py:12)")
    assert {file.name for file in course.iterdir()} == {"meet.toml", "meet.py", "places.py"}
    assert all(file.stat().st_mode & 0o777 == 0o644 and file.stat().st_size > 0 for file in course.iterdir())
    assert "could" not in said


@walled
def test_a_wall_stands_within_another():
    """A container has a filter of its own, which is no reason to do without."""
    wall = "wall_in(20, 1 << 30, []); print(lacking(), flush=True)"
    done = python(
        "-c", f"from experiments.course.wall import lacking, wall_in; {wall}; {wall}; open('/etc/passwd')", code=1
    )
    assert done.stdout.splitlines() == ["[]", "[]"]
    assert "PermissionError" in done.stderr


@pytest.mark.slow
def test_honest_laws_pass(course, tmp_path):
    found, _ = marked(course, *handed_in(tmp_path / "groups", HONEST), code=0)
    assert {name for name, each in found.items() if each["met"]} == {"(solution)", *HONEST}


@pytest.mark.slow
def test_groups_hand_in_what_they_like(course, tmp_path):
    groups = tmp_path / "groups"
    write({"meet.toml": FILE, "meet.py": LAW}, groups / "right")
    write({}, groups / "nothing")
    write({"meet.toml": "no toml", "meet.py": LAW}, groups / "spoilt")
    write({"meet.toml": posed(FILE).replace("0.9", "9.0"), "meet.py": posed(LAW)}, groups / "cheats")
    write({"meet.toml": FILE, "meet.py": LAW.replace(LINE, "x = float('nan')")}, groups / "unknown")
    found, _ = marked(course, *groups.iterdir(), code=1)
    assert {name: (each["met"], each["of"]) for name, each in found.items()} == {
        "(solution)": (1, 1), "right": (1, 1), "nothing": (0, 0), "spoilt": (0, 1), "cheats": (0, 1), "unknown": (0, 1),
    }  # fmt: skip
    assert "its law wants something that is not finite" in found["unknown"]["words"][0]
    assert found["spoilt"]["words"][0].startswith("meet.toml:1")
    table = zenpark("mark", groups / "right", "--from", course, "--seed", 5).stdout.splitlines()
    assert [line.split() for line in table[1:3]] == [["(solution)", "1/1", "1/1"], ["right", "1/1", "1/1"]]
    assert table[3] == "seeds 5 to 7; the same again with --seed 5"
    write({"meet.toml": FILE.replace("0.9", "0.1")}, course)
    assert "the solution itself misses criteria of meet: mend these" in marked(course, groups / "nothing", code=1)[1]


def test_wrong_calls_are_refused(course, tmp_path):
    says, own = tmp_path / "says", tmp_path / "own"
    for folder, metric in ((says, 'measure = "far"'), (own, 'metric = "meet.py:Apart"')):
        write({"meet.toml": FILE.replace('metric = "places.py:Apart"', metric), "meet.py": LAW + METRIC}, folder)
    for words, said in {
        (course / "none",): "none is no folder; give one for each group",
        (course, course): "two groups are named course; give their folders other names",
        (tmp_path, "--from", says): "criterion 1 judges 'far', which the law of the group says of itself; judge a",
        (tmp_path, "--from", own): "criterion 1 judges 'meet.py:Apart', which the law of the group",
        (course, "--only", "met"): "no exercise 'met'; did you mean 'meet'?",
    }.items():
        origin = () if "--from" in words else ("--from", course)
        assert said in str(invoke("mark", *words, *origin, code=1).exception)
    assert "holds no exercise" in str(invoke("course", tmp_path / "new", "--from", tmp_path, code=1).exception)


# A law that no alarm wakes, with a name for its process
SLEEPS = (
    "__import__('ctypes').CDLL(None).prctl(15, b'%s'); __import__('signal').pthread_sigmask(0, {14}); time.sleep(600)"
)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_marking_that_ends_leaves_no_process(course, tmp_path, number):
    name = f"nap-{os.getpid()}-{number}"  # an interface has at most 15 letters
    write({"meet.toml": FILE, "meet.py": LAW.replace(LINE, SLEEPS % name)}, tmp_path / "sleeps")
    words = ("mark", tmp_path / "sleeps", "--from", course, "--seeds", 1)
    with started(*GUARD, *words, env=environment(TMPDIR=str(tmp_path))) as marking:
        until(lambda: any(each.info["name"] == name for each in psutil.process_iter(["name"])), "the law sleeps")
        processes = psutil.Process(marking.pid).children(recursive=True)
        assert len(processes) >= 4  # guard, judge, nursery, cell
        marking.send_signal(number)
        marking.wait()
        until(lambda: not any(map(psutil.Process.is_running, processes)), "all are gone")


SQUARE = """
title = "A square"
duration_s = 6.0
trigger = { kind = "square.py:Late", least = 0.02 }
disturbance.all.position_sigma = 0.0005
formation.law = "square.py:Pull"
[robots.A]
kind = "khepera4"
start = [-0.5, 0.0]
[robots.B]
kind = "khepera4"
start = [0.7, 0.1]
[formation.links]
"A - B" = 0.6
[[criteria]]
metric = "residual"
at_most = 0.03
[[criteria]]
metric = "f_hz"
at_most = 3.0
"""
PULL = """
from zenpark import Gradient, Trigger

class Pull(Gradient, frozen=True):
    gain: float = 1.0

    def pull(self, apart, link):
        # blank: return (0.0, 0.0, 0.0)
        far = sum(each * each for each in apart) - link.distance**2
        return tuple(-0.5 * self.gain * far * each for each in apart)
        # end of blank

    def error(self, apart, link):
        return abs(sum(each * each for each in apart) ** 0.5 - link.distance)

class Late(Trigger, frozen=True):
    MEMORY = {"asked": 0.0}
    least: float

    def fires(self, view):
        view.memory.asked += 1.0
        return view.deviation > self.least or view.memory.asked % 50.0 == 0.0
"""


def test_stand_ins_fly_as_the_law_itself(tmp_path):
    """A law with memory and words, a gradient, and a trigger with a memory: the same flight, to the last bit."""
    write({"square.toml": SQUARE, "square.py": PULL}, tmp_path)
    leader = OURS / "06-leader.toml"
    for file, classes in (
        (leader, ["06_leader.py:Follow"]),
        (tmp_path / "square.toml", ["square.py:Pull", "square.py:Late"]),
    ):
        alone = simulate(load(file), seed=3)
        with company(classes, file.parent, file.parent, 20, 1 << 30) as cells:
            flown = simulate(load(file), seed=3)
            assert len(cells.processes) >= 3
        (one,), (other,) = alone.traces.values(), flown.traces.values()
        assert np.array_equal(one.true_position, other.true_position)
        assert alone.metrics == flown.metrics


def test_a_gradient_tells_other_robots_nothing(tmp_path):
    """Each link of a group's law has a process of its own: it finds nothing that another one left in a module."""
    told = PULL.replace("class Pull", "sides = set()\n\nclass Pull")
    told = told.replace("far = ", "sides.add(apart[0] > 0.0); far = len(sides) * ")
    flown = {}
    for name, text in {"tells": told, "alone": PULL}.items():
        write({"square.toml": SQUARE, "square.py": text}, tmp_path / name)
        with company(["square.py:Pull"], tmp_path / name, tmp_path / name, 20, 1 << 30) as cells:
            cells.leave()
            flown[name] = simulate(load(tmp_path / name / "square.toml"), seed=3)
            assert len(cells.processes) >= 3
    one, other = (next(iter(each.traces.values())) for each in flown.values())
    assert np.array_equal(one.true_position, other.true_position)


@walled
def test_learned_policies_are_marked_within_the_wall(tmp_path, monkeypatch):
    """A group hands in an ONNX file, which no process of the course computes."""
    pytest.importorskip("onnxruntime", reason="policies are the extra [policy]: ./zenpark install onnxruntime")

    def model(gain):
        return learned_bytes(2, 2, weights=((gain, 0.0), (0.0, gain)), observes="", observes_each="place")

    blank = '{ kind = "policy", file = "solution.onnx" }\n'
    text = FILE.replace('law = "meet.py:Meet"\n', f"# blank: # law = a policy\nlaw = {blank}# end of blank\n")
    course, unfit = tmp_path / "course", learned_bytes(2, 3)
    write({"meet.toml": text, "places.py": METRIC, "solution.onnx": model(0.2)}, course)
    models = {"right": model(0.2), "flees": model(-0.2), "broken": b"?", "unfit": unfit, "steals": None}
    for name, given in models.items():
        file = "solution.onnx" if given is None else "other.onnx"
        handed = {"meet.toml": text.replace("solution.onnx", file)} | ({} if given is None else {file: given})
        write(handed, tmp_path / name)
    found, _ = marked(course, *(tmp_path / name for name in models), code=1)
    assert {name for name, mark in found.items() if mark["met"] == mark["of"]} == {"(solution)", "right"}
    assert "drives the robots apart" in found["flees"]["words"][0]
    assert "output of 2 numbers; this gives 3" in found["unfit"]["words"][0]
    assert "cannot use its file" in found["broken"]["words"][0]
    assert "solution.onnx cannot be read" in found["steals"]["words"][0]
    with company([], course, course, 20, 1 << 30, learned=True) as cells:
        monkeypatch.setattr(policy, "load", None)  # none of this process
        assert simulate(load(course / "meet.toml"), seed=3).metrics["default"]
        assert len(cells.processes) >= 3


@pytest.mark.slow
def test_errors_are_computed_by_the_course(tmp_path):
    """A group whose law denies its errors, or whose trigger pretends, has not passed."""
    course = tmp_path / "course"
    write({"square.toml": SQUARE, "square.py": PULL}, course)
    lies = posed(PULL).replace("return abs(", "return 0.0 * abs(")
    talks = PULL.replace("return view.deviation > self.least", "return True")
    forgets = PULL.replace("return view.deviation", "view.deviation")
    groups = {"lies": lies, "talks": talks, "forgets": forgets, "right": PULL}
    for name, text in groups.items():
        write({"square.toml": SQUARE, "square.py": text}, tmp_path / name)
    found, said = marked(course, *(tmp_path / name for name in groups), code=1)
    met = {"(solution)": 2, "lies": 1, "talks": 1, "forgets": 0, "right": 2}
    assert {name: each["met"] for name, each in found.items()} == met
    assert "`fires` of the trigger Late must give True or False, not nothing: is a `return` missing?" in said
