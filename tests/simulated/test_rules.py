"""Rules of the laboratory are sentences of the documentation, and each can fail."""

import itertools
import re
from pathlib import Path

import pytest

from tests.simulated import look, rules
from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import PAIR

DOCS = Path(__file__).resolve().parents[2] / "docs"
# the module of rules fills the registries when it is imported
assert rules.OF_ROBOTS is look.OF_ROBOTS
ALL = [*look.OF_ROBOTS, *look.OF_PAIRS, *look.OF_COMMANDS, *look.OF_POSES, *look.AT_THE_END]


def test_all_rules_are_here():
    assert len(ALL) > 30


def test_rules_quote_the_documentation():
    text = " ".join(re.sub(r"\s+", " ", (DOCS / name).read_text("utf-8")) for name in ("safety.md", "hanging.md"))
    assert not [rule.name for rule in ALL if rule.sentence not in text]


def test_rules_have_names_of_their_own():
    assert not [one.name for one, other in itertools.combinations(ALL, 2) if one.name == other.name]


@pytest.mark.parametrize("rule", [rule for rule in ALL if not rule.sentence], ids=lambda rule: rule.name)
def test_rules_without_sentence_explain_themselves(rule):
    assert rule.check.__doc__


def test_silence_begins_after_what_a_cable_held():
    script = (Fault(1.0, "cut", "B", lasts=0.51), Fault(1.3, "pause", "router", lasts=9.0))
    flight = fly(PAIR, *script, settings=["duration_s=6"])
    assert "no connection to a router" in str(flight.robots["B"].hazards)
    assert flight.violations == []
