#!/usr/bin/env bash
# gtsam 4.3.0, pytransform3d 3.17.0, spatialmath-python 1.1.18: the six numbers of a twist begin with the rotation in
# gtsam's Pose3 and in pytransform3d, with the translation in spatialmath, and in gtsam's own Pose2. Guess: one order,
# at least within a library. So do gtsam's noise models: sigmas of a Pose2 in the order of those of a Pose3 trust places
# where they should trust yaws. Sizes fit everywhere, so nothing is refused.
# Seen: (0, 0, 0, 1, 0, 0) is a step of 1 m for the first two, a turn on the spot for spatialmath
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet gtsam==4.3.0 pytransform3d==3.17.0 spatialmath-python==1.1.18 \
    scipy==1.17.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import gtsam
import numpy as np
from pytransform3d.transformations import transform_from_exponential_coordinates
from spatialmath import SE3

TWIST = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
print("gtsam Pose3", gtsam.Pose3.Expmap(TWIST).translation().tolist())
print("pytransform3d", transform_from_exponential_coordinates(TWIST)[:3, 3].tolist())
print("spatialmath", SE3.Exp(TWIST).t.tolist(), "roll", round(float(SE3.Exp(TWIST).rpy()[0]), 3))
print("gtsam Pose2", gtsam.Pose2.Expmap(np.array([1.0, 0.0, 0.0])).translation().tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "gtsam Pose3 [1.0, 0.0, 0.0]
pytransform3d [1.0, 0.0, 0.0]
spatialmath [0.0, 0.0, 0.0] roll 1.0
gtsam Pose2 [1.0, 0.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
