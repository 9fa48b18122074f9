#!/usr/bin/env bash
# scipy 1.17.1: Rotation.from_euler("z", yaws) refuses the yaws of several robots, and takes those of one robot for one
# rotation instead of a list of it. In 1.16.3 an array of N angles about one axis were N rotations. Guess: still so; it
# is how poses of ground robots become quaternions. from_euler("z", yaws[:, None]) does it in both.
# Seen: 1.16.3 (1, 4), (3, 4), (3, 4); 1.17.1 (4,), ValueError, (3, 4)
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
cat > "$place/seen.py" <<'END'
import numpy as np
import scipy
from scipy.spatial.transform import Rotation

for name, yaws in (("one", [0.1]), ("three", [0.1, 0.2, 0.3]), ("column", [[0.1], [0.2], [0.3]])):
    try:
        print(scipy.__version__, name, Rotation.from_euler("z", np.array(yaws)).as_quat().shape)
    except ValueError:
        print(scipy.__version__, name, "ValueError")
END
seen=$(for version in 1.16.3 1.17.1; do
    "$place/venv/bin/pip" install --quiet scipy==$version numpy==2.3.5
    "$place/venv/bin/python" "$place/seen.py"
done)
printf '%s\n' "$seen"
[ "$seen" = "1.16.3 one (1, 4)
1.16.3 three (3, 4)
1.16.3 column (3, 4)
1.17.1 one (4,)
1.17.1 three ValueError
1.17.1 column (3, 4)" ] || { echo "the behaviour has changed" >&2; exit 1; }
