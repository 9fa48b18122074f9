#!/usr/bin/env bash
# control 0.10.2: forced_response and input_output_response draw straight lines between the samples of an input. Guess:
# it is held until the next one, as computers, and event-triggered controllers above all, do it. A lag whose command
# changes at 1 s answers before that. Sampled with sample_system(..., "zoh") it answers to what is held.
# Seen: at 0, 1 and 2 s 0, 0.37, 0.77 by both; held 0, 0, 0.63
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet control==0.10.2 numpy==2.4.6 scipy==1.17.1
cat > "$place/seen.py" <<'END'
import warnings

import control
import numpy as np

warnings.simplefilter("ignore")
lag = control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
TIMES, COMMAND = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0])
sampled = control.sample_system(lag, 1.0, "zoh")
for name, respond, system in (
    ("forced", control.forced_response, lag),
    ("input_output", control.input_output_response, lag),
    ("held", control.forced_response, sampled),
):
    print(name, *(respond(system, TIMES, COMMAND).outputs.round(2) + 0.0))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "forced 0.0 0.37 0.77
input_output 0.0 0.37 0.77
held 0.0 0.0 0.63" ] || { echo "the behaviour has changed" >&2; exit 1; }
