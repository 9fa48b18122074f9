"""Calls of a tick: with cold caches, each different function costs a robot 2 µs (docs/results/cost.md)."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType

import pytest

from tests.agents.swarm import Swarm, drone
from tests.small import NOISY, pair

TICKS = 20  # two decisions


def functions(swarm: Swarm, name: str) -> Counter[str]:
    """Calls of each function of the project on `TICKS` ticks of one robot."""
    group, row = swarm.where[name]
    robot = group.robots[row]
    calls: Counter[str] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and not {"agents", "twins"}.isdisjoint(Path(frame.f_code.co_filename).parts[:-1]):
            calls[f"{Path(frame.f_code.co_filename).stem}:{frame.f_code.co_qualname}"] += 1

    before = sys.getprofile()
    for _ in range(TICKS):
        t = swarm.t
        sys.setprofile(count)
        (state,) = group.body.read(t)
        robot.transmit(t, state)
        robot.act(t)
        group.body.command([robot.setpoint])
        sys.setprofile(before)
        swarm.tick += 1
    return calls


@pytest.mark.parametrize(("name", "different", "calls"), [("F", 45, 46), ("A", 49, 50)])
def test_tick_calls_few_functions(name, different, calls):
    swarm = drone(disturbance=NOISY) if name == "F" else Swarm(pair(disturbance=NOISY))
    counted = functions(swarm.running().run(1.0), name)
    found = len([each for each, count in counted.items() if count >= TICKS / 2]), sum(counted.values()) / TICKS
    assert found[0] <= different, (found, counted)
    assert found[1] <= calls, (found, counted)
