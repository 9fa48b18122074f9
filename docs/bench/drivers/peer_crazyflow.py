"""crazyflow: one world of Crazyflies under its model of the firmware's controller, 500 steps of the body a second."""

import tempfile
from contextlib import chdir
from importlib.metadata import version

import numpy as np
from crazyflow.control import Control
from crazyflow.sim import Sim

from docs.bench.drivers import ring

BODY_HZ = 500
HOVER = 0.8  # [m]


def start(robots):
    with tempfile.TemporaryDirectory() as folder, chdir(folder):  # MuJoCo writes its warnings there
        simulator = Sim(n_worlds=1, n_drones=robots, control=Control.state, freq=BODY_HZ, state_freq=100, device="cpu")
    simulator.reset()
    begin = np.full((1, robots, 3), HOVER)
    begin[0, :, :2] = ring.starts(robots)
    states = simulator.data.states
    simulator.data = simulator.data.replace(states=states.replace(pos=states.pos.at[...].set(begin)))
    place = ring.places(robots)
    command = np.zeros((1, robots, 16), dtype=np.float32)
    command[..., :3], command[..., 12] = begin, 1.0  # unit quaternion x, y, z, w

    def step():
        position = np.asarray(simulator.data.states.pos)[0, :, :2]
        command[0, :, :2] = ring.goals(position, place, "crazyflie")
        simulator.state_control(command)
        simulator.step(round(BODY_HZ * ring.STEP_S))
        return position

    return step


if __name__ == "__main__":
    ring.serve(start, version("crazyflow"))
