"""Robots in the planar engine, driven for a while, and what was seen of it."""

import numpy as np

from agents.vectors import ZERO
from twins.engines.engine import EngineInput
from twins.engines.pymunk_engine import Planar
from twins.scene import Obstacle, Scene

DT = 0.01


def stage(kinds, start, yaw=None, *, mirrored=None, scene=None, dt=DT):
    """Robots at x, y (and z), in endless room unless a scene is given."""
    n = len(kinds)
    return EngineInput(
        tuple(kinds),
        [(float(x), float(y), *(z or (0.0,))) for x, y, *z in start],
        [0.0] * n if yaw is None else [float(each) for each in yaw],
        dt,
        (False,) * n if mirrored is None else tuple(mirrored),
        Scene.empty() if scene is None else scene,
    )


def furnished(obstacles, plans=None, size=(4.0, 4.0, 3.0), walled=False):
    made = {name: Obstacle(**parts) for name, parts in obstacles.items()}
    return Scene.furnished(size, made, plans or {}, walled=walled)


def command(engine, setpoints):
    engine.command([tuple(setpoint) for setpoint in np.array(setpoints, dtype=float).tolist()])


def columns(engine, name):
    """Values of all robots as an array."""
    return np.array([getattr(motion, name) for motion in engine.motions])


class Drive:
    """An engine, told the same setpoints for a while, and what was seen of it."""

    def __init__(self, place, **choice):
        self.engine = Planar(**choice).build(place)
        self.kinds, self.rows = place.kinds, len(place.kinds)
        self.t = 0.0
        self.path, self.touches = [], []

    @property
    def position(self):
        return columns(self.engine, "position")

    @property
    def velocity(self):
        return columns(self.engine, "velocity")

    @property
    def obstacles(self):
        """(M, 3)"""
        return np.array(self.engine.obstacles)

    def go(self, seconds, setpoint=None):
        for _ in range(round(seconds / DT)):
            if setpoint is not None:
                command(self.engine, setpoint)
            self.t += DT
            self.engine.advance(self.t, [(0.0, 0.0)] * self.rows)
            self.path.append(self.position)
            self.touches += self.engine.touches()
        return self

    def put(self, row, position, yaw=0.0, *, flying=False):
        self.engine.place([row], [tuple(map(float, position))], [yaw], [flying])
        return self

    def aloft(self, position):
        """Everything that flies is put into the air."""
        flies = [row for row, kind in enumerate(self.kinds) if kind.flies]
        for row, place in zip(flies, position, strict=True):
            self.put(row, place, flying=True)
        return self

    def mirror(self, row, position, yaw=0.0, velocity=ZERO):
        self.engine.mirror([row], [tuple(position)], [yaw], [velocity])

    def overlap(self, a, b):
        """The deepest of two robots in each other on the way [m]."""
        path = np.array(self.path)
        apart = np.linalg.norm(path[:, a, :2] - path[:, b, :2], axis=1)
        return (self.kinds[a].radius + self.kinds[b].radius - apart).max()


def still(rows):
    return np.zeros((rows, 4))
