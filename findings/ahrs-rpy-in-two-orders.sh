#!/usr/bin/env bash
# ahrs 0.4.0: roll, pitch and yaw go into Quaternion(rpy=...) in this order; DCM(rpy=...) takes the first for the yaw
# and the last for the roll, and to_rpy() of it gives neither. Guess: one library, one order. A robot that has turned
# left by 30 degrees on the floor lies on its side by 30 degrees if its attitude is made by DCM.
# Seen: nose of a yaw of 30 degrees: Quaternion (0.866, 0.5, 0.0), DCM (1.0, 0.0, 0.0)
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet AHRS==0.4.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from ahrs import DCM, Quaternion

ANGLES = np.radians([0.0, 0.0, 30.0])  # roll, pitch, yaw
for name, matrix in (("Quaternion", Quaternion(rpy=ANGLES).to_DCM()), ("DCM", DCM(rpy=ANGLES))):
    print(name, "nose", (np.asarray(matrix)[:, 0].round(3) + 0.0).tolist())
print("read back", (np.degrees(Quaternion(rpy=ANGLES).to_angles()).round(3) + 0.0).tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "Quaternion nose [0.866, 0.5, 0.0]
DCM nose [1.0, 0.0, 0.0]
read back [0.0, 0.0, 30.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
