"""A plan from a file goes with its experiment, and is compared with robot and arena before a flight."""

import pytest

from experiments.check.check import check
from experiments.file import document
from experiments.file.problems import DocumentError
from tests.runs import fly

FILE = """title = "Recorded"
duration_s = 12.0
[disturbance.all]
position_sigma = 0.0003
[robots.CF01]
kind = "crazyflie"
start = [0.0, 0.0]
hover = 0.6
[[timeline]]
at_s = 2.0
robot = "CF01"
plan = { kind = "recorded", file = "path.csv" }
"""
PATH = "t,x,y,z\n0,0,0,0.6\n4,0.8,0,0.6\n5,0.8,0.1,0.7\n"


@pytest.fixture
def file(tmp_path):
    (tmp_path / "path.csv").write_text(PATH)
    (tmp_path / "task.toml").write_text(FILE)
    return tmp_path / "task.toml"


def test_file_goes_with_the_experiment(file, tmp_path):
    read = document.read(file)
    log = fly(read.experiment).log
    assert log.true_position[log.time > 8.0][0, 0] == pytest.approx((0.8, 0.1, 0.7), abs=0.05)
    kept = tmp_path / "run"
    kept.mkdir()
    read.keep(kept / "experiment.toml")
    assert (kept / "path.csv").read_text() == PATH
    (kept / "path.csv").write_text(PATH.replace("0.8", "0.9"))  # path of a robot on another machine
    sent = document.received(document.case_document(read.plan).decode(), str(kept / "robot"))
    plan = read.plan.legs_by_robot["CF01"][0].planner
    assert sent.plan.legs_by_robot["CF01"][0].planner.target(4.0, (0, 0, 0), 0.0) == pytest.approx(
        plan.target(4.0, (0, 0, 0), 0.0), nan_ok=True
    )


@pytest.mark.parametrize(
    ("old", "new", "code", "said"),
    [
        ("4,0.8", "4,0.7", "recordings", "CF01 follows path.csv: 0.17 m/s"),
        ("4,0.8,0", "0.6,0.8,0", "leader-too-fast", "path.csv, line 2: the leg at 2 s asks CF01 for 1.33 m/s"),
        (
            "0,0,0,0.6",
            "0,0,0,0.1",
            "recording-begins-elsewhere",
            "line 2: it begins at (0.00, 0.00, 0.10), 0.50 m from",
        ),
        (
            "5,0.8,0.1",
            "9.8,2.02,0.1",
            "recording-outside",
            "path.csv, line 3: it leads CF01 out of the arena, to (2.00,",
        ),
        ("5,0.8,0.1", "7,2.5,0.1", "leaves-arena", "by its plan (path.csv, line 3)"),
        (
            "4,0.8,0,0.6\n5,0.8,0.1",
            "1,0.8,0,0.6\n2,0,0",
            "recording-too-sharp",
            "line 3: it asks CF01 for 8 m",
        ),
    ],
)
def test_limits_are_compared_before_a_flight(file, old, new, code, said):
    assert old in PATH
    file.with_name("path.csv").write_text(PATH.replace(old, new))
    found = {each.code: each for each in check(document.read(file))}
    assert said in found[code].message
    assert found[code].severity == "note" or found[code].where == f"{file}:12:8"


def test_missing_file_is_said_once(file):
    with pytest.raises(DocumentError) as raised:
        document.read(file, ["timeline.0.plan.file=pat.csv"])
    (problem,) = raised.value.problems
    assert "cannot be read" in problem.message
    assert problem.hint == "did you mean 'path.csv'?"
    for name, said in (("metrics.csv", "folder of a run"), ("../path.csv", "no name of a file")):
        with pytest.raises(DocumentError, match=said):
            document.read(file, [f"timeline.0.plan.file={name}"])
