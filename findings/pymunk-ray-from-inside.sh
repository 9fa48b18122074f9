#!/usr/bin/env bash
# pymunk 7.3.1: a ray that begins inside a shape hits it at alpha 0, but its point is the far end of the ray. Guess: the
# point is where alpha says, at the beginning. A range sensor that measures to the point sees its full range where it
# stands in an obstacle; one that multiplies alpha sees 0.
# Seen: inside 0.0 (3.0, 0.0); outside 0.5 (-0.5, 0.0)
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pymunk==7.3.1
cat > "$place/seen.py" <<'END'
import pymunk

space = pymunk.Space()
space.add(pymunk.Circle(space.static_body, 0.5))
for name, begin, end in (("inside", (0.0, 0.0), (3.0, 0.0)), ("outside", (-1.0, 0.0), (0.0, 0.0))):
    hit = space.segment_query_first(begin, end, 0.0, pymunk.ShapeFilter())
    print(name, round(hit.alpha, 9), tuple(round(number, 9) for number in hit.point))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "inside 0.0 (3.0, 0.0)
outside 0.5 (-0.5, 0.0)" ] || { echo "the behaviour has changed" >&2; exit 1; }
