#!/usr/bin/env bash
# skl2onnx 1.20.0, scikit-learn 1.9.1: a network (MLPRegressor) with two outputs is written with an output of one column:
# for N observations it gives 2N rows of one number, two rows for each. A linear model gives N rows of two. Guess: the
# shape of predict(). A policy whose actions are read as rows takes the second number of an action for the next robot's.
# Seen: MLPRegressor declares [None, 1], gives (6, 1), equal to predict() only when reshaped; Ridge [None, 2] and (3, 2)
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet skl2onnx==1.20.0 scikit-learn==1.9.1 onnx==1.23.2 onnxruntime==1.32.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import warnings

import numpy as np
import onnxruntime
from skl2onnx import to_onnx
from sklearn.linear_model import Ridge
from sklearn.neural_network import MLPRegressor

warnings.simplefilter("ignore")
observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
for model in (MLPRegressor(hidden_layer_sizes=(8,), max_iter=20, random_state=0), Ridge()):
    model.fit(observations, observations[:, :2])
    written = to_onnx(model, observations[:1]).SerializeToString()
    session = onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])
    (given,) = session.run(None, {"X": observations[:3]})
    wanted = model.predict(observations[:3])
    declared = session.get_outputs()[0].shape
    print(type(model).__name__, declared, given.shape, np.allclose(given.reshape(3, 2), wanted, atol=1e-5))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "MLPRegressor [None, 1] (6, 1) True
Ridge [None, 2] (3, 2) True" ] || { echo "the behaviour has changed" >&2; exit 1; }
