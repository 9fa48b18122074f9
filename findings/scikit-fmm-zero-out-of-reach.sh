#!/usr/bin/env bash
# scikit-fmm 2025.6.23: cells that no way leads to hold a travel time of 0 beneath their mask. Guess: infinity, so that a
# planner that goes downhill stays on its side of a wall. An array without the mask, as np.asarray gives it, has the
# time of the goal itself behind the wall: downhill is through it.
# Seen: times 0.35, 0.5, 1.45, 2.43, and 0 in the wall and behind it
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet scikit-fmm==2025.6.23 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
import skfmm

goal, speed = np.ones((5, 9)), np.ones((5, 9))
goal[2, 0] = -1.0
speed[:, 4] = 0.0  # a wall from edge to edge
time = skfmm.travel_time(goal, speed)
print(type(time).__name__, np.asarray(time)[2].round(2).tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "MaskedArray [0.35, 0.5, 1.45, 2.43, 0.0, 0.0, 0.0, 0.0, 0.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
