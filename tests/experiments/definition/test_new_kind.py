"""A kind of robot that has only its sizes yet: refused in the file where it needs a twin, and drawn like others."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.body.interface import BodyError
from agents.body.kinds import KINDS, Kind
from experiments.check.analysis import Analysis
from experiments.check.ideal_run import predict
from experiments.definition.bodies import choose_bodies
from experiments.file.document import load, loads
from experiments.file.problems import DocumentError
from experiments.report import style, trajectories

KIND = "alphabot"
ROVERS = (
    'title = "Rovers"\nduration_s = 2.0\n[arena]\nsize = [12.0, 4.0, 2.0]\n'
    + "".join(
        f'[robots.R{k}]\nkind = "{KIND}"\nstart = [{k - 5}.0, 0.0]\n' for k in range(style.MAX_COLOURED_ROBOTS + 1)
    )
    + "[formation.links]\n"
    + "".join(f'"R{k} > R{k + 1}" = 1.0\n' for k in range(style.MAX_COLOURED_ROBOTS))
)


ALPHABOT = Kind(
    KIND, "twist", flies=False, radius=0.11, height=0.08, mass=0.8, endurance_s=3600.0, speed=0.3, turn_rate=2.0,
    response=1.0, turn_response=1.5,
)  # fmt: skip
MOVING = replace(ALPHABOT, motion=KINDS["khepera4"].motion)


@pytest.fixture(autouse=True)
def new_kind(monkeypatch):
    monkeypatch.setitem(KINDS.loaded, KIND, ALPHABOT)


def test_kind_without_twin_is_refused_at_its_place():
    with pytest.raises(DocumentError) as caught:
        loads(ROVERS)
    first = caught.value.problems[0]
    assert (first.line, first.message) == (6, f"no twin of '{KIND}'")
    assert "give the kind a `motion`" in first.hint


def test_kind_without_motion_model_is_refused_too(monkeypatch):
    """On the floor with velocities, not with a twist: an omnidirectional robot."""
    monkeypatch.setitem(KINDS.loaded, KIND, MOVING)
    assert loads(ROVERS)
    monkeypatch.setitem(KINDS.loaded, KIND, replace(MOVING, takes="velocity"))
    with pytest.raises(DocumentError) as caught:
        loads(ROVERS)
    assert caught.value.problems[0].line == 6


def test_unknown_setpoint_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="it must be one of position, velocity, twist"):
        replace(MOVING, takes="wheels")


def test_kind_without_protocol_twin_is_refused_by_name(monkeypatch):
    monkeypatch.setitem(KINDS.loaded, KIND, MOVING)
    with pytest.raises(BodyError, match=f"--bodies protocol: no protocol twin of '{KIND}', only of crazyflie"):
        choose_bodies(loads(ROVERS).plan, "protocol")
    assert choose_bodies(load("triangle").plan, "protocol")


def test_many_robots_of_an_uncoloured_kind_are_drawn(monkeypatch):
    monkeypatch.setitem(KINDS.loaded, KIND, MOVING)
    cases = loads(ROVERS).cases()
    figure = trajectories.expected_motion({name: Analysis(case, predict(case)) for name, case in cases.items()})
    assert ALPHABOT.colour in {line.get_color() for line in figure.axes[0].lines}
