"""Findings of `check` by their code."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np

from agents.body.interface import Disturbance
from experiments.check.check import check
from experiments.definition.experiment import Arena, Experiment, Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import Document


def of(experiment: Experiment) -> Document:
    """As if it had been read from a file."""
    plan = Plan(experiment)
    return Document(Path("made.json"), document.write_json(plan).decode(), plan, {"default": plan})


def bad(name: str, *changes: str) -> dict[str, tuple[str, str, str, str]]:
    """The first error or warning of each code: severity, message, remedy, place.

    Of cases that no change names the last one: each takes a flight on the virtual clock.
    """
    said: dict[str, tuple[str, str, str, str]] = {}
    read = document.read(name, changes)
    if not any(change.startswith("cases.") for change in changes):
        read = dataclasses.replace(read, resolved=dict(list(read.cases().items())[-1:]))
    for each in check(read):
        if each.severity != "note":
            said.setdefault(each.code, (each.severity, each.message, each.remedy, each.where))
    return said


def assert_found(name: str, change: str, expected: tuple[str, str], message: str, remedy: str) -> None:
    """A change of an experiment, or several, is found, with its place, and words of its message and of its remedy."""
    severity, code = expected
    found = bad(name, *change.split("; "))
    assert code in found
    assert found[code][0] == severity
    assert message in found[code][1]
    assert remedy in found[code][2]
    assert found[code][3]


# where the reference formation may stand: TB01, KH01..03, CF01..03 (IEEE Access 2023, section IV)
PUBLISHED = np.array(
    [
        (0, 0, 0), (0.6, 0, 0), (0.6, -0.6, 0), (0, -0.6, 0),
        (0.3, 0.098, 0.8), (0.3, -0.502, 0.8), (-0.2196, -0.2021, 0.8),
    ]
)  # fmt: skip
GROUND = {
    name: RobotTable(kind="khepera4", start=[x, y])
    for name, x, y in [("A", 0, 0), ("B", 1, 0), ("C", 0, 1), ("D", 1, 1)]
}


def ground(links: dict[str, float], leader: str | None = None, **changes) -> dict[str, str]:
    """Codes and messages of errors and warnings of four Kheperas in a large arena."""
    formation = Formation(links=links, leader=leader)
    made = Experiment(
        title="made", robots=GROUND, duration_s=60.0, arena=Arena(size=(6.0, 6.0, 2.0)), formation=formation,
        disturbance={"all": Disturbance(position_sigma=0.0005)},
    )  # fmt: skip
    found = check(of(msgspec.structs.replace(made, **changes)))
    return {each.code: each.message for each in found if each.severity != "note"}
