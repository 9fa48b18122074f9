#!/usr/bin/env bash
# pyquaternion 0.9.9: a rotation matrix in float32, as cameras and recordings give it, is refused as not orthogonal,
# since the tolerance is finer than its digits. Guess: taken, the deviation is 1e-7. With atol=1e-6 it is taken.
# Seen: float64 taken, float32 ValueError, float32 with atol=1e-6 taken
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from pyquaternion import Quaternion

turn = Quaternion(axis=[1.0, 2.0, 3.0], angle=1.0).rotation_matrix
for name, matrix, tolerance in (
    ("float64", turn, {}),
    ("float32", turn.astype(np.float32), {}),
    ("float32 with atol=1e-6", turn.astype(np.float32), {"atol": 1e-6}),
):
    try:
        Quaternion(matrix=matrix, **tolerance)
        print(name, "taken")
    except ValueError:
        print(name, "ValueError")
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "float64 taken
float32 ValueError
float32 with atol=1e-6 taken" ] || { echo "the behaviour has changed" >&2; exit 1; }
