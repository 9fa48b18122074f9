"""MuJoCo model: the scene of one quadrotor as MJCF."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from agents.body.kinds import Airframe
from twins.arrays import Array
from twins.scene import Scene

WALL: Final = 0.005  # [m] half the thickness of thin walls
STIFF: Final = 0.004  # [s] time constant of a contact: a standing drone sinks in by 0.1 mm
# front right, back right, back left, front left: direction along x and y, sign of the torque (neighbours turn opposite)
MOTORS: Final = ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1))


def mjcf(frame: Airframe, scene: Scene, step: float, motor_lag: float) -> str:
    """One quadrotor in a scene, as MJCF; heights are relative to standing on the floor.

    The state is position, quaternion, velocity in the world, angular velocity in the robot's frame, and motor thrusts.

    Args:
        scene: Only obstacles without a plan are used.
    """
    along = frame.arm / np.sqrt(2.0)
    rotors = [f'<site name="m{k}" pos="{x * along} {y * along} 0"/>' for k, (x, y, _) in enumerate(MOTORS)]
    motors = [
        f'<general site="m{k}" gear="0 0 1 0 0 {sign * frame.torque}" dyntype="filterexact" dynprm="{motor_lag}" '
        f'ctrlrange="0 {frame.thrust}"/>'
        for k, (_, _, sign) in enumerate(MOTORS)
    ]
    floor = -0.5 * frame.size[2]
    return f"""<mujoco>
<compiler angle="radian"/>
<option timestep="{step}"><flag autoreset="disable"/></option>
<default><geom solref="{STIFF} 1"/></default>
<worldbody>
<geom type="plane" pos="0 0 {floor}" size="0 0 1"/>
{"".join(_walls(scene))}{"".join(_obstacles(scene, floor))}
<body><freejoint/>
<inertial pos="0 0 0" mass="{frame.mass}" diaginertia="{_text(frame.inertia)}"/>
<geom type="box" size="{_text(0.5 * np.array(frame.size))}"/>
{"".join(rotors)}
</body>
</worldbody>
<actuator>{"".join(motors)}</actuator>
</mujoco>"""


def _walls(scene: Scene) -> list[str]:
    if not scene.walled:
        return []
    (x0, y0), (x1, y1) = scene.low[:2], scene.high[:2]
    sides = ((x0, 0.0, "1 0 0"), (x1, 0.0, "-1 0 0"), (0.0, y0, "0 1 0"), (0.0, y1, "0 -1 0"))
    return [f'<geom type="plane" pos="{x} {y} 0" zaxis="{inward}" size="0 0 1"/>' for x, y, inward in sides]


def _obstacles(scene: Scene, floor: float) -> list[str]:
    """Obstacles without a plan: boxes, cylinders, and segments of walls."""
    geoms = []
    for k, (outline, closed) in enumerate(zip(scene.outline, scene.closed, strict=True)):
        if scene.plans[k] is not None:
            continue
        x, y, yaw = scene.pose[k]
        tall = 0.5 * (scene.top[k] - scene.bottom[k])
        middle = floor + 0.5 * (scene.top[k] + scene.bottom[k])
        if outline is None:
            geoms.append(f'<geom type="cylinder" pos="{x} {y} {middle}" size="{scene.radius[k]} {tall}"/>')
        elif closed:
            size = _text((*outline.max(axis=0), tall))
            geoms.append(f'<geom type="box" pos="{x} {y} {middle}" euler="0 0 {yaw}" size="{size}"/>')
        else:
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            points = outline @ turn.T + (x, y)
            for one, other in pairwise(points):
                way, at = other - one, 0.5 * (one + other)
                size = _text((0.5 * np.hypot(*way), WALL, tall))
                along = np.arctan2(way[1], way[0])
                geoms.append(f'<geom type="box" pos="{_text((*at, middle))}" euler="0 0 {along}" size="{size}"/>')
    return geoms


def _text(numbers: Sequence[float] | Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)
