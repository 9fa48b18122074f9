"""Calls of a tick: with cold caches, each different function costs a robot 2 µs (docs/results/cost.md)."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType

import pytest

from tests.agents.few import NOISY, drone, pair
from tests.agents.swarm import Swarm

TICKS = 20  # two decisions


def functions(swarm: Swarm, name: str) -> Counter[str]:
    """Calls of each function of the project on `TICKS` ticks of one robot."""
    group, _ = swarm.where[name]
    calls: Counter[str] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and not {"agents", "twins"}.isdisjoint(Path(frame.f_code.co_filename).parts[:-1]):
            calls[f"{Path(frame.f_code.co_filename).stem}:{frame.f_code.co_qualname}"] += 1

    before = sys.getprofile()
    for _ in range(TICKS):
        t = swarm.t
        sys.setprofile(count)
        state = group.body.read(t)
        actions = group.agent.step(t, state)
        group.body.command(actions.setpoint)
        sys.setprofile(before)
        swarm.tick += 1
    return calls


@pytest.mark.parametrize(("name", "different", "calls"), [("F", 60, 82), ("A", 56, 76)])
def test_a_tick_of_a_robot_calls_few_functions(name, different, calls):
    swarm = drone(disturbance=NOISY) if name == "F" else Swarm(pair(disturbance=NOISY), [["A"], ["B"]])
    counted = functions(swarm.running().run(1.0), name)
    assert len([each for each, count in counted.items() if count >= TICKS / 2]) <= different, counted
    assert sum(counted.values()) <= calls * TICKS, counted
