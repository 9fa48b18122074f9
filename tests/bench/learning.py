"""Decisions in an environment of learning, and what they are made of."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from experiments.file.document import load
from experiments.learning.environment import Environment
from experiments.virtual_time.simulation import VirtualRun
from experiments.virtual_time.stretch import Stretches
from experiments.virtual_time.tick import Ledger
from tests.bench.measuring import Figure, median

SQUARE: Final = Path(__file__).parents[2] / "docs" / "learning_square.toml"
STEPS: Final = 20  # decisions of all robots in a measurement, of which no episode ends


def learning() -> Iterator[Figure]:
    """Decisions per CPU second of four drones, the share of ticks in plain Python, and the cost of compiled ones."""
    environment = Environment(load(SQUARE), starts=1)
    count = STEPS * len(environment.possible_agents)
    actions = {name: np.zeros(2, np.float32) for name in environment.possible_agents}

    def steps() -> None:
        for _ in range(STEPS):
            environment.step(actions)

    environment.reset(seed=1)
    steps()
    taken = median(time.process_time, steps, 2) / count
    yield Figure("learning", "decisions of a robot", 1.0 / taken, "per CPU s", 1.0, "yardstick")
    run = VirtualRun(load(SQUARE, 'formation.law="displacement"').plan, 1, lean=True)
    run.begin()

    def ticks() -> None:
        for _ in range(5 * STEPS):
            run.decide(run.time)
            run.observe(run.time)

    tick = median(time.process_time, ticks, 2) / (5 * STEPS)
    share = 5 * tick * STEPS / count / taken
    yield Figure("learning", "tick of four robots in plain Python", 1e6 * tick, "µs CPU", share, "of all, by 5 ticks")
    run.decide(run.time)
    stretches = Stretches(run)
    ledger = Ledger(stretches._members, 10, 10, start=run.time, lean=True)
    prepared = stretches._new(ledger)

    def stored() -> None:
        image = stretches._image(prepared, ledger)
        assert image is not None
        image.load()

    stored()
    taken = median(time.process_time, stored)
    yield Figure("learning", "state stored for compiled ticks, and read", 1e6 * taken, "µs CPU", taken / tick, "ticks")
