#!/usr/bin/env bash
# shapely 2.2.0: points and paths keep their heights, and interpolate() gives heights between them; lengths and
# distances leave them out: a climb of 2 m has the length 0, and two drones 2 m above each other the distance 0. Guess:
# three numbers, three dimensions. A path of 3 m along and 4 m up has its middle where it should be, and 3 m of length.
# Seen: climb 0.0, above each other 0.0, path 3.0, its middle at a height of 2
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet shapely==2.2.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
from shapely import LineString, Point

climb, path = LineString([(0, 0, 0), (0, 0, 2)]), LineString([(0, 0, 0), (3, 0, 4)])
print("climb", climb.has_z, climb.length, "apart", Point(0, 0, 0).distance(Point(0, 0, 2)))
print("path", path.length, "middle", path.interpolate(0.5, normalized=True).coords[0])
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "climb True 0.0 apart 0.0
path 3.0 middle (1.5, 0.0, 2.0)" ] || { echo "the behaviour has changed" >&2; exit 1; }
