#!/usr/bin/env bash
# ruckig 0.19.4: a trajectory that is read before its start goes on backwards in time. Guess: at_time() of a negative
# time gives the state at the start, as it gives the state at rest after the end. A robot that waits half a second for
# the common start, and follows the trajectory meanwhile, is sent 21 cm to the wrong side, at 1.25 m/s.
# Seen: at -0.5 s position -0.208, velocity 1.25; at 0 s 0.0, 0.0; a second after the end 1.0, 0.0
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet ruckig==0.19.4
cat > "$place/seen.py" <<'END'
import ruckig

asked = ruckig.InputParameter(1)
asked.current_position, asked.current_velocity, asked.current_acceleration = [0.0], [0.0], [0.0]
asked.target_position, asked.target_velocity, asked.target_acceleration = [1.0], [0.0], [0.0]
asked.max_velocity, asked.max_acceleration, asked.max_jerk = [1.0], [2.0], [10.0]
way = ruckig.Trajectory(1)
ruckig.Ruckig(1, 0.01).calculate(asked, way)
for t in (-0.5, 0.0, way.duration + 1.0):
    position, velocity, _ = way.at_time(t)
    print(f"{t:.1f} s: position {position[0]:.3f}, velocity {velocity[0]:.2f}")
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "-0.5 s: position -0.208, velocity 1.25
0.0 s: position 0.000, velocity 0.00
2.7 s: position 1.000, velocity 0.00" ] || { echo "the behaviour has changed" >&2; exit 1; }
