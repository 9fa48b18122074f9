"""Trains a policy and a trigger in the flights that they are for: .venv/bin/python docs/learning_training.py [FOLDER]

The policy sums odd functions of the error of each of three links, and adds its own velocity. That is a hidden layer of
18 tanh with tied weights. Robots believe that neighbours go on as they moved at their last pose. The policy lets them
brake instead, since a pose of a robot at rest may be lost. Eight numbers in all, which begin at rest.

An evolution strategy that adapts its covariance (N. Hansen, "The CMA evolution strategy: a tutorial", 2016) improves
them by the returns of whole flights, in the two cases of learning_square.toml that lose messages. The trigger then
learns, with that policy, when a message is worth its price. It needs the extras learn and policy, and onnx to write the
files.
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
EACH = "place wanted moves age"  # parts of an observation of each neighbour
WIDE = 4 + 7 * NEIGHBOURS  # numbers of an observation
FASTEST = 0.6  # [m/s]
# logarithms of three scales [1/m], their gains for small errors [1/s], factor of the own velocity, logarithm of the
# time for which the velocity of a pose counts [s]: a cautious beginning
FIRST = np.array([0.0, 1.5, 3.0, 0.2, 0.0, 0.0, 0.0, 0.0])
# logarithm of a threshold [m], weight of the time since the last event [cm/s], and of the error [1/100]
FIRST_TRIGGER = np.array([-4.0, 0.0, 0.0])
SPREAD = 0.2  # first deviation of these numbers
GENERATIONS, CANDIDATES = 32, 12  # numbers for a policy; a trigger has half the generations
STARTS = 8  # seeds that it flies in turn
REST = 80.0  # weight of the mean error over the last ten decisions: they count nine times
PRICE = 0.05  # error of a robot over one decision that is worth a message [m]


def layers(numbers: Array) -> dict[str, Array]:
    """Constants of the policy, by name.

    Observation (25,) → errors (6,), velocities (6,) and ages (6,) of neighbours; errors → hidden (18,) → velocity (2,);
    observation → velocity (2,).
    """
    scales, gains, brake = np.exp(numbers[:SCALES]), numbers[SCALES : 2 * SCALES], numbers[2 * SCALES]
    axes, units = 2 * NEIGHBOURS, 2 * SCALES * NEIGHBOURS
    found = {name: np.zeros((WIDE, axes)) for name in ("errors", "moves", "ages")}
    hidden, output = np.zeros((axes, units)), np.zeros((units, 2))
    for column in range(axes):
        neighbour, axis = column // 2, column % 2
        place = 4 + 7 * neighbour + axis  # row of its place, in front of the wanted one, its velocity and its age
        found["errors"][place, column], found["errors"][place + 2, column] = 1.0, -1.0
        found["moves"][place + 4, column] = found["ages"][place + 6 - axis, column] = 1.0
        for scale in range(SCALES):
            unit = SCALES * column + scale
            hidden[column, unit], output[unit, axis] = scales[scale], gains[scale] / scales[scale]
    direct = np.zeros((WIDE, 2))
    direct[2, 0] = direct[3, 1] = brake
    return found | {"hidden": hidden, "output": output, "direct": direct, "counts": np.exp(numbers[-1])}


def policy_of(numbers: Array) -> Callable[[Array], Array]:
    """The policy of eight numbers."""
    of = layers(numbers)

    def act(seen: Array) -> Array:
        ages, counts = seen @ of["ages"], of["counts"]
        errors = seen @ of["errors"] - seen @ of["moves"] * (ages - counts * (1.0 - np.exp(-ages / counts)))
        found: Array = np.tanh(errors @ of["hidden"]) @ of["output"] + seen @ of["direct"]
        return np.clip(found, -FASTEST, FASTEST)

    return act


@lru_cache(maxsize=16)
def environment(case: str, trigger: str = "", each: str = EACH) -> Environment:
    """The environment of a case, perhaps with a learned trigger; kept in each process, with its common starts."""
    changes = [f'cases.{case}.trigger={{kind="policy", model="{trigger}"}}'] if trigger else []
    document = load(FILE, 'formation.law="displacement"', *changes)
    return Environment(document, case, observes_each=each, message_price=PRICE, penalty=200.0, starts=STARTS)


def fly(
    policy: Callable[[Array], Array], case: str, seed: int, trigger: str = "", each: str = EACH
) -> tuple[float, float, int]:
    """Mean return of a robot, its mean error over the last second [m], and messages of all in one flight.

    `policy` gives velocities (N, 2) [m/s] for observations (N, K), with these parts of `each` neighbour.
    """
    many = environment(case, trigger, each)
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
    return worth([fly(policy_of(job[0]), case, job[1]) for case in HARD])


def worth(flights: Sequence[tuple[float, float, int]]) -> float:
    """Mean of what flights give."""
    return float(np.mean([total - REST * rest - PRICE * messages / 4 for total, rest, messages in flights]))


def fitness_of_trigger(job: tuple[Array, Array, int]) -> float:
    """The same of a trigger with a policy."""
    trigger, numbers, seed = job
    model = b64encode(trigger_model(trigger)).decode()
    return worth([fly(policy_of(numbers), case, seed, model) for case in HARD])


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
        return [*pool.map(fitness, [(each, 1 + generation % STARTS) for each in candidates])]

    def triggers(candidates: Array, generation: int) -> Sequence[float]:
        return [*pool.map(fitness_of_trigger, [(each, policy, 1 + generation % STARTS) for each in candidates])]

    policy = evolve(FIRST, SPREAD, generations, count, policies)
    return policy, evolve(FIRST_TRIGGER, SPREAD, generations // 2, count, triggers)


def policy_model(numbers: Array) -> bytes:
    """A policy as ONNX: one observation, float32, in; v_x, v_y out."""
    steps = [
        ("MatMul", "observation errors", "believed"), ("MatMul", "observation moves", "speeds"),
        ("MatMul", "observation ages", "age"), ("Div", "age counts", "share"), ("Neg", "share", "less"),
        ("Exp", "less", "left"), ("Sub", "one left", "gone"), ("Mul", "gone counts", "counted"),
        ("Sub", "age counted", "stale"), ("Mul", "speeds stale", "excess"), ("Sub", "believed excess", "error"),
        ("MatMul", "error hidden", "sums"), ("Tanh", "sums", "units"), ("MatMul", "units output", "pulls"),
        ("MatMul", "observation direct", "brake"), ("Add", "pulls brake", "wish"),
        ("Clip", "wish low high", "velocity"),
    ]  # fmt: skip
    metadata = {"observes": "position velocity", "observes_each": EACH, "action": "velocity"}
    others = {"low": np.array(-FASTEST), "high": np.array(FASTEST), "one": np.array(1.0)}
    return model(steps, layers(numbers) | others, ("observation", WIDE), ("velocity", 2), metadata)


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
    for case, by in ((case, by) for by in ("", learned) for case in CASES if not (by and case == "periodic")):
        total, rest, messages = np.mean([fly(policy_of(policy), case, seed, by) for seed in range(5000, 5032)], axis=0)
        name = f"{case}, learned trigger" if by else case
        print(f"{name:27} return {total:.1f} m, last second {1000 * rest:.0f} mm, {messages:.0f} messages", flush=True)


if __name__ == "__main__":
    main()
