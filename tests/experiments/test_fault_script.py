from collections import Counter

import pytest

from experiments.fault_script import KINDS, MOST, WITHOUT_VICTIM, script

ROBOTS = ("TB01", "KH01", "CF01", "CF02")


def faults(rounds):
    return [fault for each in rounds for fault in each.faults]


def test_the_same_seed_gives_the_same_script():
    assert script(ROBOTS, 45.0, 200, 7) == script(ROBOTS, 45.0, 200, 7)
    assert script(ROBOTS, 45.0, 200, 7) != script(ROBOTS, 45.0, 200, 8)


@pytest.mark.parametrize("count", [1, 5, 23, 200])
def test_every_kind_comes_as_often_as_any_other(count):
    drawn = faults(script(ROBOTS, 45.0, count, 1))
    assert len(drawn) == count
    often = Counter(fault.kind for fault in drawn)
    assert max(often.values()) - min(often[kind] for kind in KINDS) <= 1


def test_rounds_can_be_flown():
    for each in script(ROBOTS, 45.0, 200, 3):
        kinds = [fault.kind for fault in each.faults]
        assert all(kinds.count(kind) <= most for kind, most in MOST.items())
        assert "conductor" not in kinds[:-1], "nothing comes after the death of the launcher"
        assert ("failover" in kinds) <= (each.routers == 2)
        assert not (each.routers == 2 and "router" in kinds)
        for fault in each.faults:
            assert (fault.victim == "") == (fault.kind in WITHOUT_VICTIM)
            assert fault.victim in ("", *ROBOTS)
            assert fault.after_s > 0.0


def test_only_the_kinds_that_were_asked_for():
    drawn = faults(script(ROBOTS, 45.0, 30, 1, ["kill", "conductor"]))
    assert {fault.kind for fault in drawn} == {"kill", "conductor"}
    assert len(drawn) == 30
