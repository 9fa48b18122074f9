"""A tick calls few functions."""

import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.agents.bench import Swarm, drone
from tests.small import NOISY, pair

TICKS = 20  # two decisions


@pytest.mark.parametrize(("name", "different", "calls"), [("F", 45, 46), ("A", 49, 50)])
def test_tick_calls_few_functions(name, different, calls):
    """With cold caches, each different function of the project costs a robot 2 µs (docs/results/cost.md)."""
    swarm = (drone(disturbance=NOISY) if name == "F" else Swarm(pair(disturbance=NOISY))).running().run(1.0)
    (group, row), counted, before = swarm.where[name], Counter(), sys.getprofile()

    def count(frame, event, _):
        file = Path(frame.f_code.co_filename)
        if event == "call" and not {"agents", "twins"}.isdisjoint(file.parts[:-1]):
            counted[f"{file.stem}:{frame.f_code.co_qualname}"] += 1

    for _ in range(TICKS):
        sys.setprofile(count)
        (state,) = group.body.read(swarm.t)
        group.robots[row].transmit(swarm.t, state)
        group.robots[row].act(swarm.t)
        group.body.command([group.robots[row].setpoint])
        sys.setprofile(before)
        swarm.tick += 1
    assert len([each for each, number in counted.items() if number >= TICKS / 2]) <= different, counted
    assert counted.total() / TICKS <= calls, counted
