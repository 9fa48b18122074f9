#!/usr/bin/env bash
# mujoco-core 4.0.1: of the six velocities of a free joint the linear ones are along the axes of the world, the angular
# ones along those of the body; forces on it (qfrc_applied) likewise. Guess: one frame for all six. A drone that is
# started with the velocities of motion capture, both in the world, begins to turn about another axis as soon as its yaw
# is not 0.
# Seen: yaw of 90 degrees, qvel (1, 0, 0, 1, 0, 0): it moves along x of the world, and its top tilts to x, not to -y
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet mujoco-core==4.0.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import mujoco
import numpy as np

model = mujoco.MjModel.from_xml_string("""
<mujoco><option timestep="0.1" gravity="0 0 0"/>
<worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>""")
data = mujoco.MjData(model)
data.qpos[3:] = [np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]
data.qvel[:] = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]
mujoco.mj_step(model, data)
mujoco.mj_forward(model, data)
print("moved", (data.qpos[:3].round(2) + 0.0).tolist(), "top", (data.xmat[1].reshape(3, 3)[:, 2].round(2) + 0.0).tolist())
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "moved [0.1, 0.0, 0.0] top [0.1, 0.0, 1.0]" ] || { echo "the behaviour has changed" >&2; exit 1; }
