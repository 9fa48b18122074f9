"""Trains the policy of the catalogue by imitation: .venv/bin/python docs/policy_training.py [policy.onnx]

The expert is the law of a formation, v = −k Σ (p_i − p̂_j − d_ij), no faster than a limit. What is learned is a network
of two hidden layers, from random situations that the expert answers. It needs numpy, and onnx to write the file.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from experiments.catalogue import index

Array = NDArray[np.float64]

NEIGHBOURS, HIDDEN = 3, 24
GAIN, FASTEST = 0.4, 0.3  # of the expert [1/s], [m/s]
STEPS, BATCH = 6000, 512


def situations(rng: np.random.Generator, count: int) -> Array:
    """Random observations, (count, 4 + 4 n): own place and velocity, then each neighbour's place and the wanted one."""
    found = np.zeros((count, 4 + 4 * NEIGHBOURS))
    found[:, :2], found[:, 2:4] = rng.uniform(-2.0, 2.0, (count, 2)), rng.uniform(-0.3, 0.3, (count, 2))
    present = np.arange(NEIGHBOURS) < rng.integers(1, NEIGHBOURS + 1, (count, 1))
    size = np.exp(rng.uniform(np.log(0.01), np.log(1.0), (count, 1, 1)))  # errors of all sizes, small ones too
    wanted = rng.uniform(-1.5, 1.5, (count, NEIGHBOURS, 2))
    place = wanted + size * rng.normal(size=wanted.shape)
    found[:, 4:] = (np.concatenate([place, wanted], axis=2) * present[..., None]).reshape(count, -1)
    return found


def expert(observations: Array) -> Array:
    """Velocities (count, 2) of the law that is imitated [m/s]."""
    each = observations[:, 4:].reshape(len(observations), NEIGHBOURS, 4)
    wish = GAIN * (each[..., :2] - each[..., 2:]).sum(axis=1)
    speed = np.linalg.norm(wish, axis=1, keepdims=True)
    velocity: Array = wish * np.minimum(1.0, FASTEST / np.maximum(speed, 1e-9))
    return velocity


def train(seed: int = 1) -> list[Array]:
    """Weights and biases of three layers, by Adam (Kingma, Ba, ICLR 2015) on squared errors."""
    rng = np.random.default_rng(seed)
    sizes = [4 + 4 * NEIGHBOURS, HIDDEN, HIDDEN, 2]
    weights: list[Array] = []
    for rows, columns in pairwise(sizes):
        weights += [rng.normal(size=(rows, columns)) / np.sqrt(rows), np.zeros(columns)]
    first, second = [np.zeros_like(each) for each in weights], [np.zeros_like(each) for each in weights]
    for step in range(1, STEPS + 1):
        x = situations(rng, BATCH)
        w1, b1, w2, b2, w3, b3 = weights
        h1 = np.tanh(x @ w1 + b1)
        h2 = np.tanh(h1 @ w2 + b2)
        wrong = (h2 @ w3 + b3 - expert(x)) / BATCH
        back2 = wrong @ w3.T * (1.0 - h2**2)
        back1 = back2 @ w2.T * (1.0 - h1**2)
        slopes = [x.T @ back1, back1.sum(0), h1.T @ back2, back2.sum(0), h2.T @ wrong, wrong.sum(0)]
        rate = 3e-3 * (1.0 + np.cos(np.pi * step / STEPS)) / 2.0
        for k, slope in enumerate(slopes):
            first[k] = 0.9 * first[k] + 0.1 * slope
            second[k] = 0.999 * second[k] + 0.001 * slope**2
            mean, square = first[k] / (1.0 - 0.9**step), second[k] / (1.0 - 0.999**step)
            weights[k] = weights[k] - rate * mean / (np.sqrt(square) + 1e-8)
    return weights


def write(weights: list[Array], file: Path) -> None:
    """The network as ONNX: one observation, float32, in; v_x, v_y out."""
    names = ["w1", "b1", "w2", "b2", "w3", "b3"]
    nodes, at = [], "observation"
    for layer in (1, 2, 3):
        nodes.append(helper.make_node("Gemm", [at, f"w{layer}", f"b{layer}"], [at := f"sum{layer}"]))
        if layer < 3:
            nodes.append(helper.make_node("Tanh", [at], [at := f"hidden{layer}"]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, [1, len(weights[0])])],
        [helper.make_tensor_value_info(at, TensorProto.FLOAT, [1, 2])],
        [numpy_helper.from_array(each.astype(np.float32), name) for each, name in zip(weights, names, strict=True)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    file.write_bytes(model.SerializeToString(deterministic=True))


def main() -> None:
    file = Path(sys.argv[1]) if sys.argv[1:] else index.FOLDER / "policy.onnx"
    weights = train()
    write(weights, file)
    x = situations(np.random.default_rng(2), 10_000)
    h = np.tanh(np.tanh(x @ weights[0] + weights[1]) @ weights[2] + weights[3])
    error = np.linalg.norm(h @ weights[4] + weights[5] - expert(x), axis=1)
    print(f"{file}: {file.stat().st_size} bytes; errors of {1000 * np.sqrt((error**2).mean()):.0f} mm/s (rms)")


if __name__ == "__main__":
    main()
