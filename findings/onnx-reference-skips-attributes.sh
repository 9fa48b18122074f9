#!/usr/bin/env bash
# onnx 1.23.2, onnxruntime 1.32.0: the library's own reference evaluator leaves out what onnxruntime obeys: `clip` of a
# GRU, and the Softmax of opset 12 and older, which takes all axes from the first on together. Guess: the reference is
# right. Who checks an exported recurrent policy against it sees a difference, and looks for the fault in the export.
# Seen: GRU without clip 0.85, with it 0.05 and 0.85; Softmax of opset 12 0.25 and 0.5, of 13 0.5
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet onnx==1.23.2 onnxruntime==1.32.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator


def results(node, given, opset, constants=()):
    ends = [helper.make_tensor_value_info("x", TensorProto.FLOAT, given.shape)], [
        helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    ]
    graph = helper.make_graph([node], "g", *ends, [numpy_helper.from_array(a, name) for name, a in constants])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    feed = {"x": given}
    return [round(float(np.abs(run.run(None, feed)[0]).max()), 2) for run in (session, ReferenceEvaluator(model))]


WEIGHTS = [(name, np.full((1, 3, 1), 2.0, np.float32)) for name in "WR"]
for attributes in ({}, {"clip": 0.1}):
    gru = helper.make_node("GRU", ["x", "W", "R"], ["", "y"], hidden_size=1, **attributes)
    runtime, reference = results(gru, np.full((1, 1, 1), -1.0, np.float32), 18, WEIGHTS)
    print("GRU", attributes, "onnxruntime", runtime, "reference", reference)
for opset in (12, 13):
    softmax = helper.make_node("Softmax", ["x"], ["y"])
    print("Softmax", opset, *results(softmax, np.zeros((1, 2, 2), np.float32), opset))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "GRU {} onnxruntime 0.85 reference 0.85
GRU {'clip': 0.1} onnxruntime 0.05 reference 0.85
Softmax 12 0.25 0.5
Softmax 13 0.5 0.5" ] || { echo "the behaviour has changed" >&2; exit 1; }
