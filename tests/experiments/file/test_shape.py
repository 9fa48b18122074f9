"""Targets of links from the places of a shape."""

import math

import pytest

from agents.plugins import registry
from experiments.definition.experiment import LinkTable
from experiments.file import document
from experiments.file.document import DocumentError

FILE = """
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
    found = links(FILE)
    assert found["TB01 > KH01"] == LinkTable(distance=pytest.approx(0.5))
    assert found["KH01 - CF01"] == LinkTable(distance=pytest.approx(math.hypot(0.3, 0.4, 0.6)), gain=2.0)
    assert found["TB01 > CF01"] == 0.7


@pytest.mark.parametrize(("law", "target"), [("displacement", "offset"), ("bearing", "bearing")])
def test_a_law_has_the_target_that_it_needs(law, target):
    found = links(
        FILE, f'formation.law="{law}"', 'formation.links={ "TB01 > KH01" = "shape", "TB01 > CF01" = "shape" }'
    )
    assert getattr(found["TB01 > KH01"], target) == pytest.approx([-0.3, 0.4])


@pytest.mark.parametrize("law", registry.names(registry.LAWS))
def test_every_law_takes_a_shape(law):
    read = document.loads(FILE.replace(" = 0.7", ' = "shape"'), f'formation.law="{law}"')
    assert len(read.experiment.formation.links) == 3


def test_case_and_command_line_may_move_a_place():
    text = FILE + "[cases.near]\nformation.shape.KH01 = [0.7, 1.0]\n[cases.far]\nformation.shape.KH01 = [0.0, 1.0]\n"
    assert links(text, case="near")["TB01 > KH01"].distance == pytest.approx(0.3)
    assert links(text, case="far")["TB01 > KH01"].distance == pytest.approx(1.0)
    assert links(FILE, "formation.shape.KH01=[1.0, 3.0]")["TB01 > KH01"].distance == pytest.approx(2.0)


def test_a_change_may_have_a_shape():
    text = FILE + "[[formation.changes]]\nat_s = 5.0\nshape = { TB01 = [0, 0], KH01 = [0, 2], CF01 = [0, 1] }\n"
    (change,) = document.loads(text).experiment.formation.changes
    assert change.links["TB01 > KH01"].distance == pytest.approx(2.0)
    assert set(change.links) == {"TB01 > KH01", "KH01 - CF01"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("KH01 = [0.7, 1.4]\n", "", "KH01 has no place in the shape"),
        ("KH01 = [0.7, 1.4]", "KH01 = [1.0, 1.0]", "TB01 and KH01 are at one place"),
        ("KH01 = [0.7, 1.4]", "KH01 = [0.7, 1.4]\nKH1 = [0, 0]", "no robot is called 'KH1'"),
        ("KH01 = [0.7, 1.4]", "KH01 = 3", "KH01"),
        ('"TB01 > KH01" = "shape"', '"TB01 > TB01" = "shape"', "'TB01' cannot receive from itself"),
        ('"TB01 > KH01" = "shape"', '"TB01 -> KH01" = "shape"', "is no link"),
        ('"TB01 > KH01" = "shape"', '"TB01 > KH1" = "shape"', "no robot is called 'KH1'"),
        ('"TB01 > KH01" = "shape"', '"TB01 > KH01" = "shap"', "shap"),
    ],
)
def test_a_fault_names_its_place(old, new, message):
    with pytest.raises(DocumentError) as refused:
        document.loads(FILE.replace(old, new))
    assert message in str(refused.value)
    assert "text:" in str(refused.value)
