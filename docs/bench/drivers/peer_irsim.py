"""ir-sim: robots on two wheels in an arena, collisions found by the shapes' tree; no figure."""

import tempfile
from importlib.metadata import version
from pathlib import Path

import irsim
import numpy as np

from docs.bench.drivers import ring


def start(robots):
    begin, place = ring.starts(robots), ring.places(robots)
    size = 2.0 * float(np.abs(place).max()) + 4.0
    states = ", ".join(f"[{x:.6f}, {y:.6f}, 0]" for x, y in begin)
    world = f"""
world: {{height: {size}, width: {size}, offset: [{-size / 2}, {-size / 2}], step_time: {ring.STEP_S},
  collision_mode: unobstructed}}
robot:
  - number: {robots}
    distribution: {{name: manual}}
    kinematics: {{name: diff}}
    shape: {{name: circle, radius: 0.07}}
    vel_max: [0.8, 6.0]
    vel_min: [-0.8, -6.0]
    state: [{states}]
"""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(world, encoding="utf-8")
        simulator = irsim.make(str(file), headless=True, log_level="ERROR")
    everyone = list(range(robots))

    def step():
        poses = np.hstack([each.state[:3] for each in simulator.robot_list])
        velocity = ring.velocities(poses[:2].T, place)
        simulator.step(list(np.column_stack(ring.wheels(velocity, poses[2]))), everyone)
        return poses[:2].T

    return step


if __name__ == "__main__":
    ring.serve(start, version("ir-sim"))
