"""A check that cannot fail checks nothing: each is shown something that is wrong."""

import numpy as np
import pytest

from agents.network.messages import Command
from experiments.file.document import load
from tests.reliability.observer import Invariants

TRIANGLE = {"KH01": (-0.3, 0.0, 0.0), "KH02": (0.3, 0.0, 0.0), "CF01": (0.0, 0.4359, 0.6)}


@pytest.fixture
def seen():
    invariants = Invariants(load("triangle").cases()["event"])
    for name, place in TRIANGLE.items():
        invariants.place(name, place)
    return invariants


def test_all_is_well(seen):
    assert seen.violations() == []
    assert seen.formation_error(set(TRIANGLE), 1.0) < 0.001
    assert seen.nearest == pytest.approx(0.6 - 2 * 0.0704, abs=0.02)


@pytest.mark.parametrize("place", [(1.02, 0.0, 0.0), (0.0, -1.5, 0.0), (0.0, 0.8, 2.2), (0.0, 0.8, -0.2)])
def test_outside(seen, place):
    seen.place("CF01", place)
    assert seen.violations() == ["CF01 is outside the arena"]
    assert seen.violations() == [], "said once for as long as it lasts"
    seen.place("CF01", TRIANGLE["CF01"])
    assert seen.violations() == []
    seen.place("CF01", place)
    assert seen.violations() == ["CF01 is outside the arena"]


def test_overlap(seen):
    seen.place("KH02", (-0.2, 0.05, 0.0))
    assert seen.violations() == ["KH01 and KH02 overlap"]


def test_above_is_not_in_the_way(seen):
    seen.place("CF01", (-0.3, 0.0, 0.6))
    assert seen.violations() == []
    seen.place("CF01", (-0.3, 0.0, 0.01))
    assert seen.violations() == ["KH01 and CF01 overlap"]


def test_a_deformed_formation(seen):
    seen.place("KH02", (0.5, 0.0, 0.0))
    assert seen.formation_error(set(TRIANGLE), 1.0) == pytest.approx(0.2, abs=0.01)
    assert seen.formation_error({"KH01", "CF01"}, 1.0) < 0.001, "links of those that are gone do not count"


def test_nobody_knows_where_it_is(seen):
    seen.place("KH02", (np.nan, 0.0, 0.0))
    assert seen.violations() == []
    assert seen.formation_error(set(TRIANGLE), 1.0) == np.inf


@pytest.mark.parametrize(
    ("robot", "setpoint", "sane"),
    [
        ("CF01", (0.0, 0.4, 0.6, 0.0), True),
        ("CF01", (3.0, 0.4, 0.6, 0.0), False),
        ("CF01", (float("nan"), 0.4, 0.6, 0.0), False),
        ("KH01", (0.1, 1.0, 0.0, 0.0), True),
        ("KH01", (5.0, 1.0, 0.0, 0.0), False),
    ],
)
def test_commands(seen, robot, setpoint, sane):
    assert (seen.invalid_command(Command(robot, 1, 0.0, "drive", setpoint)) == "") == sane
    assert seen.invalid_command(Command(robot, 1, 0.0, "land")) == ""
