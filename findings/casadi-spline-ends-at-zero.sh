#!/usr/bin/env bash
# casadi 3.8.2: outside of its grid an interpolant of splines is 0, one of straight lines goes on. Guess: both go on, or
# both hold their last value. A map of costs or heights by "bspline", smooth for the solver, is free of costs beyond its
# edge: a planner leaves the map as soon as it can.
# Seen: at 2.5 6.5 and 6.25; at 4 14 and 0; at -1 -1 and 0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet casadi==3.8.2 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import casadi

GRID, VALUES = [[0.0, 1.0, 2.0, 3.0]], [0.0, 1.0, 4.0, 9.0]
for kind in ("linear", "bspline"):
    table = casadi.interpolant("table", kind, GRID, VALUES)
    print(kind, *(round(float(table(x)), 3) + 0.0 for x in (2.5, 4.0, -1.0)))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "linear 6.5 14.0 -1.0
bspline 6.25 0.0 0.0" ] || { echo "the behaviour has changed" >&2; exit 1; }
