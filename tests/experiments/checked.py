"""Findings of `check` by their code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agents.body.interface import Disturbance
from experiments.check.check import check
from experiments.check.findings import Finding
from experiments.definition.experiment import Arena, Experiment, Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.cases import Source
from experiments.file.document import Document
from tests.small import small

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


def as_read(experiment: Experiment) -> Document:
    """As if it had been read from a file."""
    plan = Plan(experiment)
    source = Source("made.json", document.write_json(plan).decode(), True)
    return Document(Path("made.json"), source, plan, {"default": plan}, {})


def findings(given: Document | Experiment, cases: Sequence[str] = ()) -> dict[str, Finding]:
    """First finding of each code."""
    read = given if isinstance(given, Document) else as_read(given)
    return {each.code: each for each in reversed(check(read, cases))}


def bad(name: str, *changes: str) -> dict[str, Finding]:
    """First error or warning of each code.

    Of cases that no change names, the last alone is checked: each takes a flight on the virtual clock.
    """
    read = document.read(name, changes)
    cases = [] if any(change.startswith("cases.") for change in changes) else [[*read.cases()][-1]]
    return {code: each for code, each in findings(read, cases).items() if each.severity != "note"}


def assert_found(name: str, change: str, expected: tuple[str, str], message: str, remedy: str) -> None:
    """A change of an experiment, or several, is found, with its place, and words of its message and of its remedy."""
    severity, code = expected
    found = bad(name, *change.split("; "))[code]
    assert found.severity == severity
    assert message in found.message
    assert remedy in found.remedy
    assert found.where


def ground(links: dict[str, float], leader: str | None = None, **parts) -> dict[str, Finding]:
    """Errors and warnings of four Kheperas in a large arena."""
    given = {
        "duration_s": 60.0,
        "arena": Arena(size=(6.0, 6.0, 2.0)),
        "formation": Formation(links=links, leader=leader),
        "disturbance": {"all": Disturbance(position_sigma=0.0005)},
    }
    found = findings(small(parts.pop("robots", GROUND), **{**given, **parts}))
    return {code: each for code, each in found.items() if each.severity != "note"}
