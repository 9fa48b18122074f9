#!/usr/bin/env bash
# daqp 0.11.0: a limit that is not a number is no limit, and the solution is "optimal". Guess: refused, or a solution of
# NaN, as for a NaN in the costs. A safety filter whose limit comes from the place of a neighbour that was never seen
# lets the robot drive as if nobody were there.
# Seen: limit 1.0 [0.2, 1.6], NaN [1.0, 2.0] with flag 1, as without a limit; NaN in the costs [nan, 0.0]
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet daqp==0.11.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import daqp
import numpy as np

COSTS, ROW = np.array([-1.0, -2.0]), np.array([[1.0, 0.5]])
for name, costs, limit in (
    ("1.0", COSTS, 1.0),
    ("nan", COSTS, np.nan),
    ("none", COSTS, 1e30),
    ("costs", COSTS * [np.nan, 0.0], 1.0),
):
    found, _, flag, _ = daqp.solve(np.eye(2), costs, ROW, np.array([limit]), np.array([-1e30]), np.zeros(1, np.int32))
    print(name, flag, (found.round(2) + 0.0).tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "1.0 1 [0.2, 1.6]
nan 1 [1.0, 2.0]
none 1 [1.0, 2.0]
costs 1 [nan, 0.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
