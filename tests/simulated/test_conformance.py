"""The simulated network tells of links, tokens, values and answers what the real one tells."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.simulated.conformance import RealStage, delays, differences, simulate
from tests.simulated.network_scripts import SCRIPTS

QUICK = [name for name, script in SCRIPTS.items() if script.quick]
FAR_S = 0.3  # delays of real events, which depend on the machine, are printed from here on [s]


def play(name, expected):
    """Differences of a real run from the simulated events."""
    script = SCRIPTS[name]
    real = RealStage(script).play(expected)
    for late_s, event in delays(real, expected):
        if abs(late_s) > FAR_S:
            print(f"{name}: {late_s:+.2f} s, {event}")
    return [f"{name}: {each}" for each in differences(real, expected)]


@pytest.mark.parametrize("name", SCRIPTS)
def test_seeds_change_no_history(name):
    first = simulate(SCRIPTS[name], 1)
    assert first == simulate(SCRIPTS[name], 1)
    for seed in range(2, 6):
        assert not differences(simulate(SCRIPTS[name], seed), first)


@pytest.mark.system
@pytest.mark.mechanism("network that is simulated")
def test_the_simulated_network_conforms():
    with ThreadPoolExecutor(len(QUICK)) as together:
        found = together.map(play, QUICK, [simulate(SCRIPTS[name]) for name in QUICK])
        assert [each for differing in found for each in differing] == []


@pytest.mark.system
@pytest.mark.parametrize("name", [name for name in SCRIPTS if name not in QUICK])
def test_further_scripts_conform(name):
    assert play(name, simulate(SCRIPTS[name])) == []
