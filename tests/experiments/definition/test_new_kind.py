"""A kind of robot that has only its sizes yet: refused in the file where it needs a twin, and drawn like others."""

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
COUNT = style.MAX_COLOURED_ROBOTS
ROBOTS = [f'[robots.R{k}]\nkind = "{KIND}"\nstart = [{k - 5}.0, 0.0]\n' for k in range(COUNT + 1)]
LINKS = [f'"R{k} > R{k + 1}" = 1.0\n' for k in range(COUNT)]
HEAD = 'title = "Rovers"\nduration_s = 2.0\n[arena]\nsize = [12.0, 4.0, 2.0]\n'
ROVERS = "".join([HEAD, *ROBOTS, "[formation.links]\n", *LINKS])
ALPHABOT = Kind(
    KIND, "twist", flies=False, radius=0.11, height=0.08, mass=0.8, endurance_s=3600.0, speed=0.3, turn_rate=2.0,
    response=1.0, turn_response=1.5,
)  # fmt: skip
MOVING = replace(ALPHABOT, motion=KINDS["khepera4"].motion)


@pytest.mark.parametrize(("motion", "takes"), [(None, "twist"), (KINDS["khepera4"].motion, "velocity")])
def test_kind_without_twin_is_refused_at_its_place(monkeypatch, motion, takes):
    """Without a motion model, or on the floor with velocities: an omnidirectional robot."""
    monkeypatch.setitem(KINDS.loaded, KIND, replace(ALPHABOT, motion=motion, takes=takes))
    with pytest.raises(DocumentError) as caught:
        loads(ROVERS)
    first = caught.value.problems[0]
    assert (first.line, first.message) == (6, f"no twin of '{KIND}'")
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
