#!/usr/bin/env bash
# tinympc 0.0.8: after one state of NaN every later answer is the lower limit of the input. Guess: an error, or an answer
# of NaN, and the next good state is solved as before. A position that was lost for one tick leaves a robot at full
# thrust backwards, away from its goal, without an error and without a word in the answer.
# Seen: -0.5 at 5 m and 0.5 at -5 m; -0.5 for NaN; from then on -0.5 at -5 m as well
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet tinympc==0.0.8
cat > "$place/seen.py" <<'END'
import contextlib
import io

import numpy as np
import tinympc

solver = tinympc.TinyMPC()
with contextlib.redirect_stdout(io.StringIO()):
    solver.setup(  # a point mass in a row, 0.1 s a step
        np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]), np.diag([10.0, 1.0]), np.diag([0.1]), 10
    )
free, limit = np.full((2, 10), 1e17), np.full((1, 9), 0.5)
solver.set_bound_constraints(-free, free, -limit, limit)
for position in (5.0, -5.0, float("nan"), -5.0):
    solver.set_x0(np.array([position, 0.0]))
    with contextlib.redirect_stdout(io.StringIO()):
        answer = solver.solve()
    print(f"at {position} m: input {answer['controls'][0]:.2f}, answer has {sorted(answer)}")
END
seen=$("$place/venv/bin/python" "$place/seen.py" | grep '^at ')
printf '%s\n' "$seen"
has="answer has ['controls', 'controls_all', 'states_all']"
[ "$seen" = "at 5.0 m: input -0.50, $has
at -5.0 m: input 0.50, $has
at nan m: input -0.50, $has
at -5.0 m: input -0.50, $has" ] || { echo "the behaviour has changed" >&2; exit 1; }
