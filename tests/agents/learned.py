"""Learned functions in the ONNX format, made with the library onnx: o ↦ o W + b, and with a memory m ↦ m/2 + Σ o."""

from base64 import b64encode
from functools import cache

import numpy as np
import pytest


def learned(inputs, outputs, **others):
    """Content of such a file, in base64; W is 0 if it is left out, and metadata are texts."""
    return b64encode(learned_bytes(inputs, outputs, **others)).decode()


@cache
def learned_bytes(inputs, outputs, *, bias=0.0, memory=0, kind=1, weights=None, **metadata):
    onnx = pytest.importorskip("onnx", reason="policies are written with onnx")
    made, value, number = onnx.helper, onnx.helper.make_tensor_value_info, {1: np.float32, 11: float}[kind]
    matrix = np.zeros((inputs, outputs)) if weights is None else np.array(weights)
    given = {
        "w": matrix,
        "b": np.full((1, outputs), bias),
        "half": np.full((1, memory), 0.5),
        "ones": np.ones((inputs, memory)),
    }
    nodes = [made.make_node("MatMul", ["o", "w"], ["ow"]), made.make_node("Add", ["ow", "b"], ["v"])]
    takes, gives = [value("o", kind, [1, inputs])], [value("v", kind, [1, outputs])]
    if memory:
        nodes = [made.make_node("MatMul", ["o", "w"], ["ow"]), made.make_node("ReduceSum", ["m"], ["s"], keepdims=1)]
        nodes += [made.make_node("Add", ["ow", "b"], ["owb"]), made.make_node("Add", ["owb", "s"], ["v"])]
        nodes += [made.make_node("Mul", ["m", "half"], ["mh"]), made.make_node("MatMul", ["o", "ones"], ["os"])]
        nodes += [made.make_node("Add", ["mh", "os"], ["n"])]
        takes, gives = [*takes, value("m", kind, [1, memory])], [*gives, value("n", kind, [1, memory])]
    graph = made.make_graph(
        nodes, "learned", takes, gives,
        [onnx.numpy_helper.from_array(each.astype(number), name) for name, each in given.items()],
    )  # fmt: skip
    whole = made.make_model(graph, opset_imports=[made.make_opsetid("", 17)], ir_version=8)
    made.set_model_props(whole, metadata)
    return whole.SerializeToString(deterministic=True)
