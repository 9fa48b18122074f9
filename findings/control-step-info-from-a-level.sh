#!/usr/bin/env bash
# control 0.10.2: step_info of measured data takes the response to begin at 0, also where the data begin at another
# level: a distance that goes from 5 to 6 m with a time constant of 1 s has risen after 0.52 s and settled after 2.12 s.
# Guess: times of the change, 2.20 and 3.91 s, as of the same data with 5 taken away.
# Seen: level 0: 2.2, 3.91; level 5: 0.52, 2.12
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet control==0.10.2
cat > "$place/seen.py" <<'END'
import control
import numpy as np

times = np.linspace(0.0, 10.0, 1001)
for level in (0.0, 5.0):
    seen = control.step_info(level + 1.0 - np.exp(-times), times)
    print("level", level, round(float(seen["RiseTime"]), 2), round(float(seen["SettlingTime"]), 2))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "level 0.0 2.2 3.91
level 5.0 0.52 2.12" ] || { echo "the behaviour has changed" >&2; exit 1; }
