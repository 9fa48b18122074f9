"""Decisions in an environment of learning."""

import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from experiments.file.document import load
from experiments.learning.environment import Environment
from experiments.virtual_time import stretch
from tests.bench.measuring import Figure, median

SQUARE: Final = Path(__file__).parents[2] / "docs" / "learning_square.toml"
SEED: Final = 1


def learning() -> Iterator[Figure]:
    """Decisions per CPU second in an episode of four drones, with ticks in plain Python and compiled, and a reset."""
    environment = Environment(load(SQUARE), starts=1)
    actions = {name: np.zeros(2, np.float32) for name in environment.possible_agents}

    def rate() -> float:
        """Decisions per CPU second of an episode."""
        environment.reset(seed=SEED)
        begin, count = time.process_time(), 0
        while environment.agents:
            count += len(environment.step(actions)[0])
        return count / (time.process_time() - begin)

    plain = 0.0
    for name, work in (("plain Python", -np.inf), ("compiled", np.inf)):
        stretch.WORK[0] = work
        rate()  # compiles
        found = statistics.median(rate() for _ in range(3))
        plain = plain or found
        yield Figure("learning", f"decisions of a robot, {name}", found, "per CPU s", found / plain, "× plain Python")
    reset = median(time.process_time, lambda: environment.reset(seed=SEED))
    yield Figure("learning", "reset to a start that is kept", 1e3 * reset, "ms CPU", reset * plain, "plain decisions")
    stretch.WORK[0] = 0.0
