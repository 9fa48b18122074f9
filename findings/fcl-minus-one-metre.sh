#!/usr/bin/env bash
# python-fcl 0.7.0.11: the distance of two bodies that touch or overlap is -1, whatever their sizes, unless the request
# has enable_signed_distance. Guess: 0, or how deep they are in each other. A cost or a log of clearances has a cliff
# there: from 0.01 to -1 m. With enable_signed_distance it is the depth.
# Seen: spheres with a gap of 0.01 m 0.01; in each other by 0.01 m -1.0, signed -0.01
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet python-fcl==0.7.0.11 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import fcl
import numpy as np

for gap in (0.01, -0.01):
    robots = [fcl.CollisionObject(fcl.Sphere(0.1), fcl.Transform(np.array([x, 0.0, 0.0]))) for x in (0.0, 0.2 + gap)]
    for request in (fcl.DistanceRequest(), fcl.DistanceRequest(enable_signed_distance=True)):
        print(gap, request.enable_signed_distance, round(fcl.distance(*robots, request, fcl.DistanceResult()), 3))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "0.01 False 0.01
0.01 True 0.01
-0.01 False -1.0
-0.01 True -0.01" ] || { echo "the behaviour has changed" >&2; exit 1; }
