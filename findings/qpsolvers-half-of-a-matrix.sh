#!/usr/bin/env bash
# qpsolvers 4.13.0, clarabel 0.11.1, piqp 0.7.0: solvers read one half of the matrix of the costs. Written as a triangle,
# a^2 + ab + b^2 as [[1, 1], [0, 1]] or its transpose, costs that are the same for every a and b have three solutions,
# without a word. Guess: x'Px counts, as the problem is written; or an error. 0.5 (P + P.T) has the same costs, and the
# right solution by all solvers.
# Seen: whole [0.67, 0.67] by both; upper triangle [0.5, 0.5] by both, lower one [1.0, 1.0] by both
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet qpsolvers==4.13.0 clarabel==0.11.1 piqp==0.7.0 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import warnings

import numpy as np
from qpsolvers import solve_qp

warnings.simplefilter("ignore")  # of other formats of matrices
WHOLE = np.array([[1.0, 0.5], [0.5, 1.0]])
UPPER = np.array([[1.0, 1.0], [0.0, 1.0]])
for name, costs in (("whole", WHOLE), ("upper", UPPER), ("lower", UPPER.T)):
    limits = {"lb": np.zeros(2), "ub": np.full(2, 5.0)}
    found = {kind: solve_qp(costs, np.full(2, -1.0), solver=kind, **limits) for kind in ("clarabel", "piqp")}
    print(name, *(f"{kind} {each.round(2).tolist()}" for kind, each in found.items()))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "whole clarabel [0.67, 0.67] piqp [0.67, 0.67]
upper clarabel [0.5, 0.5] piqp [0.5, 0.5]
lower clarabel [1.0, 1.0] piqp [1.0, 1.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
