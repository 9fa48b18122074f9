"""The fault laboratory: scripts for real processes, and its verdict."""

from experiments.file.document import load
from tests.reliability.chaos import KINDS, Round, findings, scripts


def test_scripts_have_as_many_faults_as_wanted():
    plan = load("triangle").cases()["event"]
    drawn = list(scripts(plan, 23, 5, KINDS))
    assert drawn == list(scripts(plan, 23, 5, KINDS)) != list(scripts(plan, 23, 6, KINDS))
    faults = [fault for _, script in drawn for fault in script]
    assert len(faults) == 23
    assert {fault.kind for fault in faults} <= {*KINDS}
    assert all(fault.since == "start" and fault.at >= 0.0 for fault in faults)


def test_verdict_names_violations_and_other_codes():
    rounds = [Round(1, ["a"], 0, 0, []), Round(2, ["b", "c"], 1, 0, ["KH01 is not down"])]
    assert [(line.mark, line.text) for line in findings(rounds)] == [
        ("bad", "3 faults, 1 violations"),
        ("fair", "seed 2: exit code 1, simulated 0"),
        ("bad", "seed 2: KH01 is not down"),
    ]
