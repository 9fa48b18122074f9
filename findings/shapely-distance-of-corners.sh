#!/usr/bin/env bash
# shapely 2.2.0: frechet_distance compares corners of two lines, not the lines: a straight path of
# two points and the same path, 1 m beside it, recorded with a point in its middle are 5.1 m apart. Guess: 1 m, as both
# are straight. A flight that follows its plan of few waypoints perfectly is scored by the distance of these points.
# With densify=0.01 it is right to 1 %.
# Seen: two points 1.0, densified 1.0; three points 5.1, densified 1.0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet shapely==2.2.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
from shapely import LineString, frechet_distance

plan = LineString([(0, 0), (10, 0)])
for name, flown in (("two points", [(0, 1), (10, 1)]), ("three points", [(0, 1), (5, 1), (10, 1)])):
    flown = LineString(flown)
    print(name, *(round(frechet_distance(plan, flown, densify=share), 1) for share in (None, 0.01)))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "two points 1.0 1.0
three points 5.1 1.0" ] || { echo "the behaviour has changed" >&2; exit 1; }
