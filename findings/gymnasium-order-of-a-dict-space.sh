#!/usr/bin/env bash
# gymnasium 1.4.0: Dict({...}) sorts its keys by the alphabet; Dict(key=...) and Dict([...]) keep the order in which
# they are written. flatten() follows it, so that one observation becomes two vectors. Guess: one order, that of the
# code, or of the alphabet. A policy that was trained on one and is fed by the other takes speeds for places, with no
# error.
# Seen: dictionary [2.0, 1.0]; keywords [1.0, 2.0]; list of pairs [1.0, 2.0]
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from gymnasium.spaces import Box, Dict, flatten

ONE = Box(-9.0, 9.0, (1,), np.float32)
OBSERVATION = {"velocity": np.ones(1, np.float32), "place": np.full(1, 2.0, np.float32)}
for name, space in (
    ("dictionary", Dict({"velocity": ONE, "place": ONE})),
    ("keywords", Dict(velocity=ONE, place=ONE)),
    ("list of pairs", Dict([("velocity", ONE), ("place", ONE)])),
):
    print(name, *space, flatten(space, OBSERVATION).tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "dictionary place velocity [2.0, 1.0]
keywords velocity place [1.0, 2.0]
list of pairs velocity place [1.0, 2.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
