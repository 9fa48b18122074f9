#!/usr/bin/env bash
# pytransform3d 3.17.0: quaternion_slerp goes the long way round if the signs of two quaternions differ, as they do in
# recordings of motion capture and filters, between one sample and the next. Guess: the shorter way, as scipy's Slerp,
# spatialmath and numpy-quaternion have it. Resampled so, a drone that turns by 5.7 degrees is upside down, or looks
# back, in the middle. With shortest_path=True the way is the shorter one.
# Seen: half way from 0 to 5.73 degrees: 182.86; with shortest_path 2.86; scipy 2.86
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pytransform3d==3.17.0 scipy==1.17.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import numpy as np
from pytransform3d.rotations import quaternion_slerp
from scipy.spatial.transform import Rotation, Slerp


def yaw(w, _x, _y, z):
    return round(float(np.degrees(2.0 * np.arctan2(z, w)) % 360.0), 2)


before, after = np.array([1.0, 0.0, 0.0, 0.0]), -np.array([np.cos(0.05), 0.0, 0.0, np.sin(0.05)])
print("pytransform3d", yaw(*quaternion_slerp(before, after, 0.5)))
print("shortest_path", yaw(*quaternion_slerp(before, after, 0.5, shortest_path=True)))
both = Rotation.from_quat([before, after], scalar_first=True)
print("scipy", yaw(*Slerp([0.0, 1.0], both)(0.5).as_quat(scalar_first=True)))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "pytransform3d 182.86
shortest_path 2.86
scipy 2.86" ] || { echo "the behaviour has changed" >&2; exit 1; }
