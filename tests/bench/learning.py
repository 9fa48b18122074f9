"""Decisions in an environment of learning, beside those of VMAS where it is installed."""

import time
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.file.document import load
from experiments.learning.environment import Environment
from experiments.learning.vector import Environments
from experiments.virtual_time import stretch
from tests.bench.measuring import Figure

FILES: Final = {"": "", " at 100 Hz": "rates.body_hz=100.0"}
SQUARE: Final = Path(__file__).parents[2] / "docs" / "learning_square.toml"
COUNTS: Final = (1, 32, 256)  # environments of a vector
STARTS: Final = 2
SEED: Final = 1
STEPS: Final = 60  # decisions of a robot in an episode
TURNS: Final = 3


def learning() -> Iterator[Figure]:
    """Decisions per CPU second of four drones, whole episodes with their resets: in Python, compiled, in vectors."""
    plain = 0.0
    for words, change in FILES.items():
        environment = Environment(load(SQUARE, change) if change else load(SQUARE), starts=1)
        actions = {name: np.zeros(2, np.float32) for name in environment.possible_agents}

        def episode(environment: Environment = environment, actions: dict[str, Any] = actions) -> int:
            environment.reset(seed=SEED)
            return sum(len(environment.step(actions)[0]) for _ in range(STEPS))

        for name, work in (("plain Python", (-np.inf, 0.0)), ("compiled", (np.inf, 0.0)), ("by cc", (np.inf, 1e3))):
            stretch.RECENT.clear()
            stretch.DRIVERS.clear()
            environment.flights.clear()
            stretch.WORK[:] = work
            found = rate(episode)
            plain = plain or found
            yield Figure("learning", f"{name}{words}", found, "decisions per CPU s", found / plain, "× plain Python")
            begin = time.process_time()
            environment.reset(seed=SEED)
            reset = time.process_time() - begin
            yield Figure("learning", f"reset, {name}{words}", 1e3 * reset, "ms CPU", reset * plain, "plain decisions")
    for count in COUNTS:
        found = rate(vectors(count))
        yield Figure("learning", f"vector of {count}", found, "decisions per CPU s", found / plain, "× plain Python")
    stretch.WORK[:] = 0.0, 0.0
    for count in COUNTS if find_spec("vmas") else ():
        found = rate(navigation(count))
        yield Figure("learning", f"VMAS, {count}", found, "decisions per CPU s", found / plain, "× plain Python")


def vectors(count: int) -> Callable[[], int]:
    """Episodes in a vector of `count` environments in this process."""
    vector = Environments(Environment(load(SQUARE), starts=STARTS), count, processes=1)
    vector.reset(seed=SEED)
    zeros = np.zeros((vector.num_envs, 2))
    return lambda: sum(len(vector.step(zeros)[0]) for _ in range(STEPS))


def navigation(count: int) -> Callable[[], int]:
    """Episodes of VMAS's `navigation` with four agents, in `count` environments on one thread."""
    torch = import_module("torch")
    torch.set_num_threads(1)
    environments = import_module("vmas").make_env("navigation", num_envs=count, device="cpu", n_agents=4, seed=SEED)
    zeros = [torch.zeros(count, 2) for _ in range(4)]

    def episode() -> int:
        environments.reset()
        return sum(count * len(environments.step(zeros)[0]) for _ in range(STEPS))

    return episode


def rate(episode: Callable[[], int]) -> float:
    """Decisions per CPU second, the median of a few turns behind two that warm up."""
    found = list[float]()
    for _ in range(TURNS + 2):
        begin = time.process_time()
        found.append(episode() / (time.process_time() - begin))
    return sorted(found[2:])[TURNS // 2]
