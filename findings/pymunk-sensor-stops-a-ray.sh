#!/usr/bin/env bash
# pymunk 7.3.1: shapes that are sensors, through which bodies drive, are hit by rays and found by queries of points.
# Guess: queries see what is solid. A zone that only counts who is in it hides the wall behind it from the range
# sensors, and is an obstacle for a planner that asks for the nearest shape. A ShapeFilter with a mask leaves it out.
# Seen: range to a wall at 2 m behind a zone at 1 m: 0.5, with a mask 2.0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pymunk==7.3.1
cat > "$place/seen.py" <<'END'
import pymunk

ZONE = 0b10
space = pymunk.Space()
zone = pymunk.Circle(space.static_body, 0.5, (1.0, 0.0))
zone.sensor, zone.filter = True, pymunk.ShapeFilter(categories=ZONE)
space.add(zone, pymunk.Segment(space.static_body, (2.0, -1.0), (2.0, 1.0), 0.0))
for name, mask in (("all", pymunk.ShapeFilter.ALL_MASKS()), ("mask", pymunk.ShapeFilter.ALL_MASKS() ^ ZONE)):
    hit = space.segment_query_first((0.0, 0.0), (4.0, 0.0), 0.0, pymunk.ShapeFilter(mask=mask))
    print(name, round(4.0 * hit.alpha, 3))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "all 0.5
mask 2.0" ] || { echo "the behaviour has changed" >&2; exit 1; }
