#!/usr/bin/env bash
# osqp 1.1.3: update() with a lower bound above its upper one prints a line of error, raises nothing and returns None.
# The next solve() goes on with the bounds of before and says "solved". setup() raises for the same bounds. Guess: an
# exception, or "primal infeasible". A controller whose safe speeds have just become an empty set drives on by those of
# the step before.
# Seen: setup raises OSQPException; update None, solved with x at the old bound
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet osqp==1.1.3 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import numpy as np
import osqp
from scipy.sparse import csc_matrix

ONE = csc_matrix([[1.0]])
solver = osqp.OSQP()
solver.setup(ONE, np.array([-9.0]), ONE, np.array([0.0]), np.array([0.3]), verbose=False)
print(solver.solve().info.status, round(float(solver.solve().x[0]), 2))
print("update", solver.update(l=np.array([0.2]), u=np.array([0.1])), flush=True)
found = solver.solve()
print(found.info.status, round(float(found.x[0]), 2))
try:
    osqp.OSQP().setup(ONE, np.array([-9.0]), ONE, np.array([0.2]), np.array([0.1]), verbose=False)
except osqp.OSQPException as error:
    print(type(error).__name__)
END
seen=$("$place/venv/bin/python" -u "$place/seen.py" | grep -v ^ERROR)
printf '%s\n' "$seen"
[ "$seen" = "solved 0.3
update None
solved 0.3
OSQPException" ] || { echo "the behaviour has changed" >&2; exit 1; }
