#!/usr/bin/env bash
# supersuit 3.11.0 with stable-baselines3 2.9.2: a vector that supersuit makes for stable-baselines3 (`base_class`) cannot
# be seeded, so that PPO(..., seed=1) ends with an AttributeError of the wrapper. Guess: a seed works, as with any vector
# of that library. Without one each training is another one; torch's seed alone does not make two of them equal.
# Seen: AttributeError: 'ConcatVecEnv' object has no attribute 'seed'
set -euo pipefail
place=$(mktemp -d); trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet supersuit==3.11.0 stable-baselines3==2.9.2 pettingzoo==1.27.0 gymnasium==1.4.0
cat > "$place/seen.py" <<'END'
import numpy as np
import supersuit
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

ONE = Box(-1.0, 1.0, (1,), np.float32)


class Still(ParallelEnv):
    metadata = {"name": "still", "is_parallelizable": True}
    render_mode = None
    possible_agents = ["a", "b"]
    observation_spaces = action_spaces = {"a": ONE, "b": ONE}

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        return {name: np.zeros(1, np.float32) for name in self.agents}, {name: {} for name in self.agents}

    def step(self, actions):
        none = dict.fromkeys(self.agents, False)
        return self.reset()[0], dict.fromkeys(self.agents, 0.0), none, none, {name: {} for name in self.agents}


single = supersuit.pettingzoo_env_to_vec_env_v1(Still())
vector = supersuit.concat_vec_envs_v1(single, 2, num_cpus=1, base_class="stable_baselines3")
PPO("MlpPolicy", vector, n_steps=8, batch_size=8)
try:
    PPO("MlpPolicy", vector, n_steps=8, batch_size=8, seed=1)
except AttributeError as error:
    print(f"AttributeError: {error}")
END
seen=$("$place/venv/bin/python" -W ignore "$place/seen.py")
printf '%s\n' "$seen"
[ "$seen" = "AttributeError: 'ConcatVecEnv' object has no attribute 'seed'" ] \
    || { echo "the behaviour has changed" >&2; exit 1; }
