#!/usr/bin/env bash
# qpsolvers 4.13.0 with quadprog 0.1.14: a problem with a solution has none if a limit is an array of whole numbers:
# solve_qp returns None, as for limits that contradict each other, and only warns. Guess: the numbers are converted, as
# the solver piqp 0.7.0 has it, or an error is raised. A safety filter that takes None for "no safe speed" always stops.
# Seen: quadprog float [0.0, 1.0], int None; piqp [0.0, 1.0] for both
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet qpsolvers==4.13.0 quadprog==0.1.14 piqp==0.7.0 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import numpy as np
from qpsolvers import solve_qp

for solver in ("quadprog", "piqp"):
    for kind in (float, int):
        limit = np.array([[1, 0]], dtype=kind), np.array([0], dtype=kind)
        solved = solve_qp(np.eye(2), np.array([-1.0, -1.0]), *limit, solver=solver)
        print(solver, kind.__name__, None if solved is None else (np.abs(solved.round(6))).tolist())
END
seen=$("$place/venv/bin/python" -W ignore "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "quadprog float [0.0, 1.0]
quadprog int None
piqp float [0.0, 1.0]
piqp int [0.0, 1.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
