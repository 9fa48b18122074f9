"""Robots in the planar engine, driven for a while, and what was seen of it."""

import numpy as np

from agents.vectors import ZERO
from twins.engines.engine import EngineInput
from twins.engines.pymunk_engine import Planar
from twins.scene import Obstacle, Scene

DT = 0.01


def stage(kinds, start, yaw=None, *, mirrored=None, scene=None, dt=DT):
    n = len(kinds)
    places = [(float(x), float(y), 0.0) for x, y, *_ in start]
    yaws = [float(each) for each in (yaw if yaw is not None else [0.0] * n)]
    return EngineInput(tuple(kinds), places, yaws, dt, tuple(mirrored or (False,) * n), scene or Scene.empty())


def furnished(obstacles, plans=None, size=(4.0, 4.0, 3.0), walled=False):
    made = {name: Obstacle(**parts) for name, parts in obstacles.items()}
    return Scene.furnished(size, made, plans or {}, walled=walled)


def command(engine, setpoints):
    for motion, setpoint in zip(engine.motions, np.array(setpoints, dtype=float).tolist(), strict=True):
        motion.command(tuple(setpoint))


def columns(engine, name):
    return np.array([getattr(motion, name) for motion in engine.motions])


class Drive:
    """An engine, told the same setpoints for a while, and what was seen of it; who begins at a height, flies."""

    def __init__(self, kinds, start, yaw=None, *, mirrored=None, scene=None, **choice):
        self.engine = Planar(**choice).build(stage(kinds, start, yaw, mirrored=mirrored, scene=scene))
        self.kinds, self.rows = kinds, len(kinds)
        self.t, self.path, self.touches = 0.0, [], []
        for row, place in enumerate(start):
            if len(place) == 3:
                self.put(row, place, flying=True)

    @property
    def position(self):
        return columns(self.engine, "position")

    @property
    def velocity(self):
        return columns(self.engine, "velocity")

    @property
    def obstacles(self):
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

    @property
    def pairs(self):
        """Who touched whom, in order; -1: an obstacle, -2: a wall."""
        return [(touch.first, touch.second) for touch in self.touches]

    @property
    def x(self):
        """x of the first robot [m]."""
        return self.position[0, 0]

    def mirror(self, row, position, yaw=0.0, velocity=ZERO):
        self.engine.mirror([row], [tuple(position)], [yaw], [velocity])

    def overlap(self, a, b):
        """The deepest of two robots in each other on the way [m]."""
        path = np.array(self.path)
        apart = np.linalg.norm(path[:, a, :2] - path[:, b, :2], axis=1)
        return (self.kinds[a].radius + self.kinds[b].radius - apart).max()
