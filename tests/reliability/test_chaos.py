"""The fault laboratory: scripts for real processes, and its verdict."""

import re

from experiments.file.document import load
from tests.conftest import ROOT
from tests.reliability.chaos import KINDS, UNREAL, Round, findings, scripts


def test_scripts_have_as_many_faults_as_wanted():
    plan = load("triangle").cases()["event"]
    drawn = list(scripts(plan, 23, 5, KINDS))
    assert drawn == list(scripts(plan, 23, 5, KINDS)) != list(scripts(plan, 23, 6, KINDS))
    faults = [fault for _, script in drawn for fault in script]
    assert len(faults) == 23
    assert {fault.kind for fault in faults} <= {*KINDS}
    assert "launch" not in {fault.since for fault in faults}


def test_page_has_each_kind_of_fault_once():
    page = (ROOT / "docs" / "chaos.md").read_text("utf-8").partition("test --chaos`\n\nRuns")[2]
    for head, kinds in (("| kind | done by |", KINDS), ("| kind | why it is simulated alone |", UNREAL)):
        rows = page.partition(head)[2].partition("\n\n")[0].splitlines()[2:]
        assert {kind for row in rows for kind in re.findall(r"`(\w+)`", row.split("|")[1])} == {*kinds}


def test_verdict_names_violations_and_other_codes():
    rounds = [Round(1, ["a"], 0, 0, []), Round(2, ["b", "c"], 1, 0, ["KH01 is not down"])]
    assert [(line.mark, line.text) for line in findings(rounds)] == [
        ("bad", "3 faults, 1 violations"),
        ("fair", "seed 2: exit code 1, simulated 0"),
        ("bad", "seed 2: KH01 is not down"),
    ]
