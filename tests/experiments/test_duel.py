"""Robots without links, on plans of their own: what a first user tries, from the file to the report."""

import re

import pytest

from experiments.check.check import check
from experiments.file.document import load, read
from experiments.report.page import number
from experiments.run import simulate
from tools.commands import run as commands

pytestmark = pytest.mark.slow  # runs and reports, whole

FILE = """
title = "duel"
duration_s = 9.0
[arena]
size = [3.0, 3.0, 2.0]
[world]
engine = "pymunk"
[robots.TB01]
kind = "turtlebot3"
start = [-1.0, 0.0]
[robots.TB02]
kind = "turtlebot3"
start = [1.0, 0.0, 3.14159]
[[timeline]]
at_s = 0.0
robot = "TB01"
plan = { kind = "waypoints", points = [[1.0, 0.0]], speed = 0.2 }
[[timeline]]
at_s = 0.0
robot = "TB02"
plan = { kind = "waypoints", points = [[-1.0, 0.0]], speed = 0.2 }
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "duel.toml"
    path.write_text(FILE)
    return path


def test_it_runs_and_reports_without_links(file, tmp_path, capsys):
    assert commands.run(str(file), virtual=True, out=str(tmp_path / "run")) == 1
    printed = capsys.readouterr()
    said = printed.out
    assert "TB01 at 7.5 s: it does not obey commands to move" in printed.err + said  # they push each other
    assert "no link was measured" in said
    assert "One collision in default: TB01–TB02" in said
    page = re.sub(r"<[^>]+>", " ", (tmp_path / "run" / "report.html").read_text("utf-8"))
    assert "TB01–TB02" in page
    assert "Not where the plan wanted them at the end of default: TB01 by" in page
    assert "never stayed" not in page


def test_they_push_each_other_and_neither_arrives(file):
    run = simulate(load(str(file)))
    (blow,) = [each for each in run.traces["default"].contacts if {each.first, each.second} == {"TB01", "TB02"}]
    assert blow.stamp == pytest.approx(5.5, abs=0.1)  # 0.895 m at 0.2 m/s, behind a plan by 1 s
    assert 0.05 < blow.impulse < 0.4  # reduced mass 0.5 kg, closing at 0.4 m/s
    assert 0.0 <= blow.overlap < 0.001
    assert all(robot.short > 0.5 for robot in run.metrics["default"].robots)


def test_unlinked_robot_goes_its_way_beside_a_formation(tmp_path):
    path = tmp_path / "three.toml"
    third = '[robots.KH01]\nkind = "khepera4"\nstart = [-1.0, 0.6]\n[formation.links]\n"TB01 > KH01" = 0.6\n'
    path.write_text(FILE + third)
    errors = [finding for finding in check(read(path)) if finding.severity == "error"]
    assert not [error for error in errors if "falls into" in error.message], errors


def test_rounding_is_no_result():
    assert [number(value) for value in (-2.8e-15, 2.0e-4)] == ["0", "2.0e-04"]
