#!/usr/bin/env bash
# osqp 1.1.3: the x of a problem without a solution is 2143289344 in every place, which are the bits of a NaN,
# 0x7fc00000, taken for a whole number. The status says "primal infeasible". Guess: NaN, or None as 0.6.7
# gives. A controller that asks for finite numbers only sends 2143289344 m/s to its clamp, and its robots drive at full
# speed.
# Seen: primal infeasible, finite True, 2143289344; dual infeasible the same
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet osqp==1.1.3 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import numpy as np
import osqp
from scipy.sparse import csc_matrix

for name, weight, low, high in (
    ("no speed", 1.0, [1.0, -2.0], [2.0, -1.0]),
    ("any speed", 0.0, [-np.inf] * 2, [1.0] * 2),
):
    solver = osqp.OSQP()
    limits = csc_matrix([[1.0], [1.0]])
    solver.setup(csc_matrix([[weight]]), np.array([1.0]), limits, np.array(low), np.array(high), verbose=False)
    found = solver.solve()
    print(name, found.info.status, np.isfinite(found.x).all(), *found.x.astype(int), hex(int(found.x[0])))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "no speed primal infeasible True 2143289344 0x7fc00000
any speed dual infeasible True 2143289344 0x7fc00000" ] || { echo "the behaviour has changed" >&2; exit 1; }
