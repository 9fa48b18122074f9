"""Trains a policy and a trigger in the flights that they are for: .venv/bin/python docs/learning_training.py [FOLDER]

The policy sums odd functions of the error of each of three links, and adds its own velocity. That is a hidden layer of
18 tanh with tied weights: seven numbers in all, which begin at rest. An evolution strategy that adapts its
covariance (N. Hansen, "The CMA evolution strategy: a tutorial", 2016) improves them by the returns of whole flights, in
the two cases of learning_square.toml that lose messages. The trigger then learns, with that policy, when a message is
worth its price. It needs the extras learn and policy, and onnx to write the files.
"""

from __future__ import annotations

import sys
from base64 import b64encode
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from zenpark import Array, Environment, load

FILE = Path(__file__).with_name("learning_square.toml")
CASES = ("periodic", "event", "event-loss", "poor")
HARD = CASES[2:]  # cases in which it learns
NEIGHBOURS, SCALES = 3, 3
FASTEST = 0.6  # [m/s]
# logarithms of three scales [1/m], their gains for small errors [1/s], factor of the own velocity: a cautious beginning
FIRST = np.array([0.0, 1.5, 3.0, 0.2, 0.0, 0.0, 0.0])
# logarithm of a threshold [m], weight of the time since the last event [cm/s], and of the error [1/100]
FIRST_TRIGGER = np.array([-4.0, 0.0, 0.0])
SPREAD = 0.2  # first deviation of these numbers
GENERATIONS, CANDIDATES = 16, 10  # of a policy; a trigger has half of these generations
REST = 40.0  # weight of the mean error over the last ten decisions: they count five times
PRICE = 0.1  # error of a robot over one decision that is worth a message [m]


def layers(numbers: Array) -> tuple[Array, Array, Array]:
    """Weights of the policy: observation (16,) → hidden (18,), hidden → velocity (2,), observation → velocity."""
    scales, gains, brake = np.exp(numbers[:SCALES]), numbers[SCALES : 2 * SCALES], numbers[-1]
    hidden, output = np.zeros((4 + 4 * NEIGHBOURS, 2 * SCALES * NEIGHBOURS)), np.zeros((2 * SCALES * NEIGHBOURS, 2))
    for unit in range(2 * SCALES * NEIGHBOURS):
        neighbour, scale, axis = unit // (2 * SCALES), unit // 2 % SCALES, unit % 2
        place = 4 + 4 * neighbour + axis  # where the neighbour is; two behind it, where it should be
        hidden[place, unit], hidden[place + 2, unit] = scales[scale], -scales[scale]
        output[unit, axis] = gains[scale] / scales[scale]
    direct = np.zeros((4 + 4 * NEIGHBOURS, 2))
    direct[2, 0] = direct[3, 1] = brake
    return hidden, output, direct


def policy_of(numbers: Array) -> Callable[[Array], Array]:
    """The policy of seven numbers."""
    hidden, output, direct = layers(numbers)
    return lambda seen: np.clip(np.tanh(seen @ hidden) @ output + seen @ direct, -FASTEST, FASTEST)


@lru_cache(maxsize=8)
def environment(case: str, trigger: str = "") -> Environment:
    """The environment of a case, perhaps with a learned trigger; kept in each process, with its common starts."""
    changes = [f'cases.{case}.trigger={{kind="policy", model="{trigger}"}}'] if trigger else []
    document = load(FILE, 'formation.law="displacement"', *changes)
    return Environment(document, case, message_price=PRICE, penalty=200.0, starts=4)


def fly(policy: Callable[[Array], Array], case: str, seed: int, trigger: str = "") -> tuple[float, float, int]:
    """Mean return of a robot, its mean error over the last second [m], and messages of all in one flight.

    `policy` gives velocities (N, 2) [m/s] for observations (N, 16).
    """
    many = environment(case, trigger)
    observations, _ = many.reset(seed=seed)
    errors, messages = [], 0
    while many.agents == many.possible_agents:  # to the end, or to the first contact
        actions = policy(np.array([*observations.values()]))
        observations, reward, *_, infos = many.step(dict(zip(observations, actions, strict=True)))
        sent = sum(info["messages"] for info in infos.values())
        messages += sent
        errors.append(-(sum(reward.values()) + PRICE * sent) / len(many.possible_agents))
    return -sum(errors), float(np.mean(errors[-10:])), messages


def fitness(job: tuple[Array, int]) -> float:
    """Mean return of a policy over the hard cases, less the weight of its rest and the price of its messages."""
    found = [fly(policy_of(job[0]), case, job[1]) for case in HARD]
    return float(np.mean([total - REST * rest - PRICE * messages / 4 for total, rest, messages in found]))


def fitness_of_trigger(job: tuple[Array, Array, int]) -> float:
    """The same of a trigger with a policy, in the case with losses."""
    trigger, numbers, seed = job
    total, rest, messages = fly(policy_of(numbers), "event-loss", seed, b64encode(trigger_model(trigger)).decode())
    return total - REST * rest - PRICE * messages / 4


def evolve(
    first: Array, spread: float, generations: int, count: int, measure: Callable[[Array, int], Sequence[float]]
) -> Array:
    """Mean of the last generation, by CMA-ES; `measure` gives the returns of candidates in a generation."""
    rng, n = np.random.default_rng(1), len(first)
    best = count // 2
    weights = np.log(best + 0.5) - np.log(np.arange(1, best + 1))
    weights /= weights.sum()
    effective = 1.0 / (weights**2).sum()
    c_path, c_one = (4 + effective / n) / (n + 4 + 2 * effective / n), 2 / ((n + 1.3) ** 2 + effective)
    c_rank = min(1 - c_one, 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective))
    c_step = (effective + 2) / (n + effective + 5)
    damping = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (n + 1)) - 1) + c_step
    length = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))  # of a normal vector
    mean, covariance, path, path_step = first.copy(), np.eye(n), np.zeros(n), np.zeros(n)
    for generation in range(generations):
        root, axes = np.linalg.eigh(covariance)
        deviations = rng.normal(size=(count, n)) * np.sqrt(np.maximum(root, 1e-20)) @ axes.T
        returns = np.array(measure(mean + spread * deviations, generation))
        chosen = deviations[np.argsort(-returns)[:best]]
        move = weights @ chosen
        mean = mean + spread * move
        whitened = axes @ ((axes.T @ move) / np.sqrt(np.maximum(root, 1e-20)))
        path_step = (1 - c_step) * path_step + np.sqrt(c_step * (2 - c_step) * effective) * whitened
        path = (1 - c_path) * path + np.sqrt(c_path * (2 - c_path) * effective) * move
        ranks, line = (chosen.T * weights) @ chosen, np.outer(path, path)
        covariance = (1 - c_one - c_rank) * covariance + c_one * line + c_rank * ranks
        spread *= float(np.exp(c_step / damping * (np.linalg.norm(path_step) / length - 1)))
        print(f"{generation + 1:3}: {returns.max():.2f}, mean {returns.mean():.2f}, spread {spread:.3f}", flush=True)
    return mean


def train(pool: ProcessPoolExecutor, generations: int = GENERATIONS, count: int = CANDIDATES) -> tuple[Array, Array]:
    """Numbers of a policy, and of a trigger for it."""

    def policies(candidates: Array, generation: int) -> Sequence[float]:
        return [*pool.map(fitness, [(each, 1 + generation % 4) for each in candidates])]

    def triggers(candidates: Array, generation: int) -> Sequence[float]:
        return [*pool.map(fitness_of_trigger, [(each, policy, 1 + generation % 4) for each in candidates])]

    policy = evolve(FIRST, SPREAD, generations, count, policies)
    return policy, evolve(FIRST_TRIGGER, SPREAD, generations // 2, count, triggers)


def policy_model(numbers: Array) -> bytes:
    """A policy as ONNX: one observation, float32, in; v_x, v_y out."""
    constants = dict(zip(("hidden", "output", "direct"), layers(numbers), strict=True))
    steps = [
        ("MatMul", "observation hidden", "sums"), ("Tanh", "sums", "units"), ("MatMul", "units output", "pulls"),
        ("MatMul", "observation direct", "brake"), ("Add", "pulls brake", "wish"),
        ("Clip", "wish low high", "velocity"),
    ]  # fmt: skip
    metadata = {"observes": "position velocity", "observes_each": "place wanted", "action": "velocity"}
    limits = {"low": np.array(-FASTEST), "high": np.array(FASTEST)}
    return model(steps, constants | limits, ("observation", 4 + 4 * NEIGHBOURS), ("velocity", 2), metadata)


def trigger_model(numbers: Array) -> bytes:
    """A trigger as ONNX: deviation [m], time since the last event [s] and error [m] in; fires above 0."""
    threshold, time, error = numbers
    weights = {"weights": np.array([[1.0], [time / 100], [error / 100]]), "threshold": np.array(np.exp(threshold))}
    steps = [("MatMul", "judged weights", "sum"), ("Sub", "sum threshold", "fires")]
    return model(steps, weights, ("judged", 3), ("fires", 1), {})


def model(
    steps: list[tuple[str, str, str]],
    constants: dict[str, Array],
    given: tuple[str, int],
    found: tuple[str, int],
    metadata: dict[str, str],
) -> bytes:
    """A model of these operators, each with the names that it takes and gives."""
    nodes = [helper.make_node(name, takes.split(), [gives]) for name, takes, gives in steps]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size]) for name, size in (given, found)]
    values = [numpy_helper.from_array(each.astype(np.float32), name) for name, each in constants.items()]
    graph = helper.make_graph(nodes, "learned", ends[:1], ends[1:], values)
    whole = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(whole, metadata)
    onnx.checker.check_model(whole)
    return whole.SerializeToString(deterministic=True)


def main() -> None:
    folder = Path(sys.argv[1]) if sys.argv[1:] else FILE.parent
    with ProcessPoolExecutor() as pool:
        policy, trigger = train(pool)
    (folder / "learned.onnx").write_bytes(policy_model(policy))
    (folder / "learned-trigger.onnx").write_bytes(trigger_model(trigger))
    print(np.round(policy, 3).tolist(), np.round(trigger, 3).tolist())
    learned = b64encode(trigger_model(trigger)).decode()
    for case, by in (*((case, "") for case in CASES), ("event", learned), ("event-loss", learned)):
        total, rest, messages = np.mean([fly(policy_of(policy), case, seed, by) for seed in range(900, 908)], axis=0)
        name = f"{case}, learned trigger" if by else case
        print(f"{name:27} return {total:.1f} m, last second {1000 * rest:.0f} mm, {messages:.0f} messages", flush=True)


if __name__ == "__main__":
    main()
