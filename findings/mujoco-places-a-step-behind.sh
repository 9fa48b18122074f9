#!/usr/bin/env bash
# mujoco-core 4.0.1: behind mj_step() qpos and time are of the end of the step; xpos, site_xpos and all sensors are of
# its beginning. Guess: all of data is of one moment. A log of xpos against time is a step late, 10 mm at 1 m/s and
# steps of 10 ms, which looks like an error of the controller. mj_forward() brings all to one moment.
# Seen: after 0.03 s at 1 m/s qpos 0.03, xpos and sensor 0.02; after mj_forward 0.03
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet mujoco-core==4.0.1 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import mujoco

model = mujoco.MjModel.from_xml_string("""
<mujoco><option timestep="0.01" gravity="0 0 0"/>
<worldbody><body><freejoint/><geom size="0.1"/><site name="middle"/></body></worldbody>
<sensor><framepos objtype="site" objname="middle"/></sensor></mujoco>""")
data = mujoco.MjData(model)
data.qvel[0] = 1.0
for _ in range(3):
    mujoco.mj_step(model, data)
print("step", *(round(float(each), 3) for each in (data.time, data.qpos[0], data.xpos[1, 0], data.sensordata[0])))
mujoco.mj_forward(model, data)
print("forward", *(round(float(each), 3) for each in (data.time, data.qpos[0], data.xpos[1, 0], data.sensordata[0])))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "step 0.03 0.03 0.02 0.02
forward 0.03 0.03 0.03 0.03" ] || { echo "the behaviour has changed" >&2; exit 1; }
