#!/usr/bin/env bash
# gymnasium 1.4.0: RescaleAction maps -1 to 1 onto the limits of the environment, and what is larger beyond them. Guess:
# it is clipped, or refused, as an action out of the action space. A Gaussian policy gives 2 now and then: the robot
# learns, and flies, at twice its largest speed. A clip to [-1, 1] has to stand in front of it, in the policy.
# Seen: action 2.0 of a space from -1 to 1 arrives as 0.6 where the limit is 0.3
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.4.6
cat > "$place/seen.py" <<'END'
import warnings

import gymnasium
import numpy as np
from gymnasium.spaces import Box

warnings.simplefilter("ignore")


class Robot(gymnasium.Env):
    observation_space, action_space = Box(-1.0, 1.0, (1,)), Box(-0.3, 0.3, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        print("speed", round(float(action[0]), 2))
        return np.zeros(1, np.float32), 0.0, False, False, {}


robot = gymnasium.wrappers.RescaleAction(Robot(), np.float32(-1.0), np.float32(1.0))
robot.reset()
for action in (1.0, 2.0):
    print("action", action, "in the space", robot.action_space.contains(np.array([action], np.float32)))
    robot.step(np.array([action], np.float32))
END
seen=$("$place/venv/bin/python" "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "action 1.0 in the space True
speed 0.3
action 2.0 in the space False
speed 0.6" ] || { echo "the behaviour has changed" >&2; exit 1; }
