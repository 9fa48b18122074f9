"""Targets of links: from the places of a shape, and those that a law has."""

import math

import pytest

from agents.formation.link import BY_NOTHING
from agents.plugins import registry
from experiments.catalogue import index
from experiments.check.check import check
from experiments.definition.experiment import LinkTable
from experiments.file import document
from experiments.file.problems import DocumentError

AVERAGE = index.find_file("average")
SHAPE = """
title = "Shape"
duration_s = 10.0
[robots.TB01]
kind = "turtlebot3"
start = [0.0, 0.0]
[robots.KH01]
kind = "khepera4"
start = [-0.5, 0.4]
[robots.CF01]
kind = "crazyflie"
start = [0.5, 0.4]
hover = 0.6
[formation.shape]
TB01 = [1.0, 1.0]
KH01 = [0.7, 1.4]
CF01 = [1.0, 1.8]
[formation.links]
"TB01 > KH01" = "shape"
"KH01 - CF01" = { gain = 2.0 }
"TB01 > CF01" = 0.7
"""


def links(text, *changes, case="default"):
    return document.loads(text, *changes).cases()[case].experiment.formation.links


def test_lengths_hold_between_places_at_robots_heights():
    found = links(SHAPE)
    assert found["TB01 > KH01"] == LinkTable(distance=pytest.approx(0.5))
    assert found["KH01 - CF01"] == LinkTable(distance=pytest.approx(math.hypot(0.3, 0.4, 0.6)), gain=2.0)
    assert found["TB01 > CF01"] == 0.7


@pytest.mark.parametrize("law", registry.names(registry.LAWS))
def test_law_has_the_target_that_it_needs(law):
    found = links(SHAPE.replace(" = 0.7", ' = "shape"'), f'formation.law="{law}"')
    assert len(found) == 3
    target = {"displacement": "offset", "bearing": "bearing"}.get(law)
    assert target is None or getattr(found["TB01 > KH01"], target) == pytest.approx([-0.3, 0.4])


def test_case_command_line_and_change_move_places():
    text = SHAPE + "[cases.near]\nformation.shape.KH01 = [0.7, 1.0]\n[cases.far]\nformation.shape.KH01 = [0.0, 1.0]\n"
    assert links(text, case="near")["TB01 > KH01"].distance == pytest.approx(0.3)
    assert links(text, case="far")["TB01 > KH01"].distance == pytest.approx(1.0)
    assert links(SHAPE, "formation.shape.KH01=[1.0, 3.0]")["TB01 > KH01"].distance == pytest.approx(2.0)
    text = SHAPE + "[[formation.changes]]\nat_s = 5.0\nshape = { TB01 = [0, 0], KH01 = [0, 2], CF01 = [0, 1] }\n"
    (change,) = document.loads(text).experiment.formation.changes
    assert change.links["TB01 > KH01"].distance == pytest.approx(2.0)
    assert set(change.links) == {"TB01 > KH01", "KH01 - CF01"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("formation.update=send-on-delta", "no function of its input alone"),
        ('architecture={ kind = "hybrid", robots = ["KH01"] }', "guided robots transmit no variables"),
        ("formation.anchors={ KH01 = 0.5 }", "'average' does not know them"),
        ("cases.event.trigger=relative", "'relative' judges errors of links"),
        ("cases.event.trigger=self-triggered", "does not see the variables"),
        ("formation.law=distance", "needs a target of every link"),
        ("formation.law=mixed", "give a distance, an offset or a bearing"),
    ],
)
def test_averaging_law_needs_no_targets(change, message):
    with pytest.raises(DocumentError, match=message):
        document.read(AVERAGE, [change])
    plan = document.read(AVERAGE, ['formation.links={ "KH01 > KH04" = { from_s = 2.0 } }']).cases()["event"]
    (link,) = plan.one_way_links
    assert (link.sender, link.receiver, link.since, link.target.wants) == ("KH01", "KH04", 2.0, BY_NOTHING)


@pytest.mark.slow
def test_check_warns_of_words_that_are_lost():
    text = AVERAGE.read_text("utf-8").replace("duration_s = 30.0", "duration_s = 2.0")
    for given, warned in ((text, False), (text.replace(", maximum_silence_s = 1.0", ""), True)):
        assert ("lost-words" in {each.code for each in check(document.loads(given))}) is warned
