#!/usr/bin/env bash
# filterpy 2.0.0: kinematic_kf(dim=2, order=1), a filter of a point in the plane, measures the sum of x and y. Guess: a
# measurement has two numbers, one of each axis. With measurements of the sum, a robot at (1, 3) is taken to be at
# (2, 2); all residuals are zero.
# Seen: H [[1.0, 0.0, 1.0, 0.0]], estimate (2.0, 2.0)
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet filterpy==2.0.0 numpy==2.4.6 scipy==1.17.1 matplotlib==3.11.2
cat > "$place/seen.py" <<'END'
import numpy as np
from filterpy.common import kinematic_kf

seen = kinematic_kf(dim=2, order=1, dt=0.1)
print("H", seen.H.tolist())
seen.P *= 100.0
for _ in range(500):
    seen.predict()
    seen.update(np.full((seen.dim_z, 1), 1.0 + 3.0))
print("estimate", (round(float(seen.x[0, 0]), 2), round(float(seen.x[2, 0]), 2)))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "H [[1.0, 0.0, 1.0, 0.0]]
estimate (2.0, 2.0)" ] || { echo "the behaviour has changed" >&2; exit 1; }
