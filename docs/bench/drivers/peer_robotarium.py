"""The Robotarium's simulator: unicycles, with a check of all pairs for collisions, in steps of 33 ms."""

from importlib.metadata import version

import numpy as np
from rps.robotarium import Robotarium

from docs.bench.drivers import ring


def start(robots):
    begin = np.vstack([ring.starts(robots).T, np.zeros(robots)])
    simulator = Robotarium(number_of_robots=robots, show_figure=False, sim_in_real_time=False, initial_conditions=begin)
    place, everyone = ring.places(robots), np.arange(robots)

    def step():
        poses = simulator.get_poses()
        velocity = ring.velocities(poses[:2].T, place)
        simulator.set_velocities(everyone, np.vstack(ring.wheels(velocity, poses[2])))
        simulator.step()
        return poses[:2].T

    return step


if __name__ == "__main__":
    ring.serve(start, version("robotarium-python-simulator"), step_s=0.033)
