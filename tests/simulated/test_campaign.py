"""Random scripts break no rule, and a seed is the same flight whenever and wherever it is flown."""

import os
import subprocess
import sys
from collections.abc import Iterable

import pytest

from tests.simulated import campaign, laboratory
from tests.simulated.faults import Fault
from tests.simulated.laboratory import ROOT

FIRST, PARTS, EACH = 1, 50, 4  # seeds of every test run, in parts that workers share: two minutes of a core
ONCE_BROKEN = (
    150074, 160297, 503847, 504632, 601467, 632983, 804139, 806045, 809981, 811752, 812597, 817399, 1008094, 1008574,
    1022336, 1027577,
)  # fmt: skip
NIGHTLY, NIGHTLY_PARTS, NIGHTLY_EACH = 100_000, 50, 96  # seeds that make 5,000 with the others

TRACES = """
import sys
from tests.simulated import campaign, laboratory
for seed in map(int, sys.argv[1:]):
    flight = laboratory.run(campaign.request_of(seed))
    print(flight.trace, flight.code, flight.ended)
laboratory.close()
"""


def failures(seeds: Iterable[int]) -> str:
    found = (campaign.failure(seed, campaign.ALL, laboratory.nursery(), flight) for seed, flight in fly(seeds))
    return "\n".join(text for text in found if text)


def fly(seeds: Iterable[int]):
    return campaign.fly(seeds, campaign.ALL, laboratory.nursery())


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_random_scripts_break_no_rule(part):
    first = FIRST + EACH * part
    assert not (found := failures(range(first, first + EACH))), found


@pytest.mark.slow
def test_once_broken_rules_hold():
    assert not (found := failures(ONCE_BROKEN)), found


@pytest.mark.nightly
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("part", range(NIGHTLY_PARTS))
def test_thousands_of_scripts_break_no_rule(part):
    first = NIGHTLY + NIGHTLY_EACH * part
    assert not (found := failures(range(first, first + NIGHTLY_EACH))), found


@pytest.mark.slow
def test_seeds_repeat_to_the_last_switch():
    seeds = ["3", "7"]  # a capture and a world
    printed = set()
    for hashes in ("0", "1"):
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": hashes}
        command = [sys.executable, "-c", TRACES, *seeds]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        printed.add(done.stdout)
    assert len(printed) == 1, printed
    assert len(set(printed.pop().splitlines())) == len(seeds)


@pytest.mark.slow
def test_flight_asks_nothing_of_the_real_world():
    asks = laboratory.Mutant("agents/runtime/loop.py", "self._read(t)\n", "self._read(t + 0.0 * time.time_ns())\n")
    with pytest.raises(laboratory.SimulatorError, match=r"asks the real world: time\.time_ns"):
        laboratory.fly("triangle", case="event", mutant=asks)


@pytest.mark.slow
def test_broken_rule_is_shrunk_to_its_faults():
    blind = laboratory.Mutant("agents/safety/detection.py", "found |= 1 << Cause.ROUTER", "found |= 0")
    noise = [Fault(t, "late", "KH01", 0.005, 0.2) for t in (0.5, 1.0, 4.0, 5.0)]
    script = (*noise[:2], Fault(1.5, "cut", "KH02", lasts=6.0), *noise[2:])
    settings = ("duration_s=8",)
    request = laboratory.Request("triangle", script, case="event", settings=settings, mutant=blind)
    flight = laboratory.run(request)
    assert campaign.broken(flight) == {"hold-without-router"}
    assert campaign.shrink(request, flight, laboratory.nursery())[0] == [script[2]]
    assert "campaign --one 7 -v" in campaign.failure(
        7, campaign.ALL, laboratory.nursery(), laboratory.SimulatorError("spins")
    )
