#!/usr/bin/env bash
# scipy 1.17.1: lsim, step and impulse of a system whose matrices are whole numbers compute its states in whole numbers:
# a double integrator, written [[0, 1], [0, 0]], pushed with 0.5 m/s² stays where it is for ever. Guess: converted, as
# cont2discrete and place_poles do with the same matrices. Nothing warns; one decimal point in each matrix mends it.
# Seen: place after 3 s: whole numbers 0.0, floats 2.25; step of a first-order lag 0 and 0.95
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet scipy==1.17.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from scipy import signal

TIMES = np.linspace(0.0, 3.0, 31)
for kind in (int, float):
    integrator = [np.array(each, kind) for each in ([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]])]
    lag = [np.array(each, kind) for each in ([[-1]], [[1]], [[1]], [[0]])]
    place = signal.lsim(integrator, np.full(31, 0.5), TIMES)[1]
    print(kind.__name__, round(float(place[-1]), 2), round(float(signal.step(lag, T=TIMES)[1][-1]), 2))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "int 0.0 0.0
float 2.25 0.95" ] || { echo "the behaviour has changed" >&2; exit 1; }
