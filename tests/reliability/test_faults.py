from collections import Counter

import pytest

from experiments.definition.plan import Plan
from experiments.file.document import load
from tests.reliability.chaos import ALWAYS, AVOIDANCE, defaults
from tests.reliability.faults import FAULT_KINDS, FAULTS, next_fault, script

ROBOTS = ("TB01", "KH01", "CF01", "CF02")


def test_the_same_seed_gives_the_same_script():
    assert script(ROBOTS, 200, 7) == script(ROBOTS, 200, 7)
    assert script(ROBOTS, 200, 7) != script(ROBOTS, 200, 8)


@pytest.mark.parametrize("count", [1, 5, 23, 200])
def test_every_kind_comes_as_often_as_any_other(count):
    drawn = script(ROBOTS, count, 1)
    assert len(drawn) == count
    often = Counter(fault.kind for fault in drawn)
    assert max(often.values()) - min(often[kind] for kind in FAULTS) <= 1


def flown(waiting, duration_s=90.0):
    """Faults of a round, each of which takes as long as it usually does."""
    stage, t, begun = waiting[0].properties.stage, 15.0, Counter()
    while (fault := next_fault(waiting, stage, begun, duration_s - t)) is not None:
        waiting.remove(fault)
        begun[fault.kind] += 1
        t += fault.after_s + fault.properties.lasts_s + fault.properties.heals_s
        yield fault
        if fault.kind == "conductor":
            return


def test_rounds_can_be_flown():
    drawn = script(ROBOTS, 300, 3)
    waiting, rounds = list(drawn), []
    while waiting:
        rounds.append((waiting[0].properties.stage, list(flown(waiting))))
    assert Counter(map(repr, drawn)) == Counter(repr(fault) for _, faults in rounds for fault in faults)
    assert max(len(faults) for _, faults in rounds) > 4
    assert len(rounds) < 60, "the launcher dies in the last seconds of a round, not in one of its own"
    for stage, faults in rounds:
        kinds = [fault.kind for fault in faults]
        assert kinds
        assert all(kinds.count(kind) <= FAULT_KINDS[kind].most for kind in kinds)
        assert {FAULT_KINDS[kind].stage for kind in kinds} <= {"plain", stage}
        assert not (stage == "two routers" and "router" in kinds)
        for fault in faults:
            assert bool(fault.victim) == fault.properties.victim
            assert fault.victim in ("", *ROBOTS)
            assert fault.after_s > 0.0
            low, high = fault.properties.size
            assert low <= abs(fault.size) <= high
            assert fault.size >= 0.0 or fault.properties.signed


def test_no_fault_begins_that_could_not_heal():
    waiting = script(ROBOTS, 14, 1)
    assert next_fault(waiting, "plain", {}, 3.9) is None
    assert next_fault(waiting, "plain", {}, 10.0).kind == "conductor"
    assert next_fault(waiting, "plain", {}, 60.0).kind != "conductor"


def test_faults_that_disband_come_last():
    waiting = script(ROBOTS, 6, 1, ["refused-landing", "sleep"])
    kinds = [fault.kind for fault in flown(waiting)]
    assert kinds == ["sleep", "sleep", "refused-landing"]


def test_only_the_kinds_that_were_asked_for():
    drawn = script(ROBOTS, 30, 1, ["kill", "conductor"])
    assert {fault.kind for fault in drawn} == {"kill", "conductor"}
    assert len(drawn) == 30


def test_every_kind_is_defined_in_a_sentence():
    assert all(kind.begin.__doc__.endswith(".") for kind in FAULT_KINDS.values())


def test_defaults_keep_robots_apart_and_fit_files_rates():
    assert AVOIDANCE in defaults(load("robotic-park").plan)
    assert "rates.body_hz=50" in defaults(load("robotic-park").plan)
    avoiding = load("robotic-park", 'avoidance.kind="potential"', "rates.pose_hz=100").experiment
    assert defaults(Plan(avoiding)) == list(ALWAYS)
