#!/usr/bin/env bash
# pymunk 7.3.1: a robot whose velocity is set before each step drives through a wall: the solver takes the speed away at
# the end of a step, and by then the body has moved. Guess: the wall stops it, as it is solid. A velocity_func that sets
# the same speed, or a force towards it, is stopped.
# Seen: after 3 m: set 3.0 m, behind the wall at 1 m; velocity_func 0.93; force 0.93
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet pymunk==7.3.1
cat > "$place/seen.py" <<'END'
import pymunk

SPEED = 0.3


def drive(way):
    space, body = pymunk.Space(), pymunk.Body(1.0, 1.0)
    space.add(body, pymunk.Circle(body, 0.06), pymunk.Segment(space.static_body, (1.0, -1.0), (1.0, 1.0), 0.01))
    if way == "velocity_func":
        body.velocity_func = lambda body, *_: setattr(body, "velocity", (SPEED, 0.0))
    for _ in range(2000):
        if way == "set":
            body.velocity = SPEED, 0.0
        elif way == "force":
            body.apply_force_at_local_point((5.0 * (SPEED - body.velocity.x), 0.0))
        space.step(0.005)
    return round(body.position.x, 2)


for way in ("set", "velocity_func", "force"):
    print(way, drive(way))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "set 3.0
velocity_func 0.93
force 0.93" ] || { echo "the behaviour has changed" >&2; exit 1; }
