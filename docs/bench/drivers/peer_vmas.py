"""VMAS by TorchRL's wrapper, one world: point masses moved by forces, in the scenario with the least beside them.

VMAS has the GPL: nothing of this repository imports it. `dropout` has no collisions, and its step of 0.1 s and its drag
cannot be set.
"""

from importlib.metadata import version

import numpy as np
import torch
from torchrl.envs.libs.vmas import VmasEnv

from docs.bench.drivers import ring

STEP_S, DRAG = 0.1, 0.25


def start(robots):
    torch.set_num_threads(1)
    simulator = VmasEnv(scenario="dropout", num_envs=1, device="cpu", n_agents=robots, start_same_point=True)
    state = simulator.reset()
    for agent, begin in zip(simulator.agents, ring.starts(robots), strict=True):
        agent.set_pos(torch.tensor(begin[None], dtype=torch.float32), batch_index=None)
    position, velocity, place = ring.starts(robots), np.zeros((robots, 2)), ring.places(robots)

    def step():
        nonlocal state, position, velocity
        wanted = ring.velocities(position, place)
        force = np.clip((wanted - (1.0 - DRAG) * velocity) / STEP_S, -1.0, 1.0)
        state["agents", "action"] = torch.tensor(force[None], dtype=torch.float32)
        state = simulator.step(state)["next"]
        seen = state["agents", "observation"][0].numpy()
        position, velocity = seen[:, :2], seen[:, 2:4]
        return position

    return step


if __name__ == "__main__":
    ring.serve(start, f"{version('vmas')} (TorchRL {version('torchrl')})", step_s=STEP_S)
