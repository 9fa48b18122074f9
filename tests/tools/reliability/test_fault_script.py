from collections import Counter

import pytest

from experiments.file.document import load
from tools.reliability import chaos_round
from tools.reliability.chaos import ALWAYS, AVOIDANCE, defaults
from tools.reliability.fault_script import FAULT_KINDS, FAULTS, script, take_round

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


def test_rounds_can_be_flown():
    drawn = script(ROBOTS, 300, 3)
    waiting, rounds = list(drawn), []
    while waiting:
        rounds.append(take_round(waiting, 90.0))
    assert Counter(map(repr, drawn)) == Counter(repr(fault) for each in rounds for fault in each.faults)
    assert max(len(each.faults) for each in rounds) > 4
    for each in rounds:
        kinds = [fault.kind for fault in each.faults]
        assert kinds
        assert all(kinds.count(kind) <= FAULT_KINDS[kind].most for kind in kinds)
        assert "conductor" not in kinds[:-1], "nothing comes after the death of the launcher"
        assert {FAULT_KINDS[kind].stage for kind in kinds} <= {"plain", each.stage}
        assert not (each.stage == "two routers" and "router" in kinds)
        for fault in each.faults:
            assert bool(fault.victim) == fault.properties.victim
            assert fault.victim in ("", *ROBOTS)
            assert fault.after_s > 0.0
            low, high = fault.properties.size
            assert low <= abs(fault.size) <= high
            assert fault.size >= 0.0 or fault.properties.signed


def test_only_the_kinds_that_were_asked_for():
    drawn = script(ROBOTS, 30, 1, ["kill", "conductor"])
    assert {fault.kind for fault in drawn} == {"kill", "conductor"}
    assert len(drawn) == 30


def test_every_kind_is_known_to_those_that_do_it_and_that_look_after_it():
    tables = {name for name, kind in FAULT_KINDS.items() if kind.signal or kind.cuts or kind.clock}
    assert set(FAULTS) - tables == {"double", "read-error", "disk", "corrupt"}, "done by functions of their own"
    looked_after = {name.removeprefix("_after_").replace("_", "-") for name in vars(chaos_round.ChaosRound)}
    assert {kind for kind in FAULTS if kind in looked_after} == {
        "kill", "clock", "read-error", "clock-behind", "double", "frozen-router", "mocap-clock"
    }  # fmt: skip


def test_defaults_keep_robots_apart_and_fit_the_rates_of_the_file():
    assert AVOIDANCE in defaults(load("robotic-park").experiment)
    assert "rates.body_hz=50" in defaults(load("robotic-park").experiment)
    avoiding = load("robotic-park", 'avoidance.kind="potential"', "rates.pose_hz=100").experiment
    assert defaults(avoiding) == list(ALWAYS)
