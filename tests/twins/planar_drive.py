"""Robots in the planar engine, driven for a while, and what was seen of it."""

import numpy as np

from twins.engines.engine import Stage
from twins.engines.pymunk_engine import Planar
from twins.scene import Obstacle, Scene

DT = 0.01


def stage(kinds, start, yaw=None, *, copy=None, mirrored=None, scene=None, dt=DT):
    """Rows at x, y (and z), in endless room unless a scene is given."""
    n = len(kinds)
    start = np.array(start, dtype=float)
    start = np.column_stack([start, np.zeros((n, 3 - start.shape[1]))])
    return Stage(
        tuple(kinds),
        start,
        np.zeros(n) if yaw is None else np.array(yaw, dtype=float),
        dt,
        np.zeros(n, dtype=np.intp) if copy is None else np.array(copy),
        np.zeros(n, dtype=bool) if mirrored is None else np.array(mirrored),
        Scene.empty() if scene is None else scene,
    )


def furnished(obstacles, plans=None, size=(4.0, 4.0, 3.0), walled=False):
    made = {name: Obstacle(**parts) for name, parts in obstacles.items()}
    return Scene.furnished(size, made, plans or {}, walled=walled)


class Drive:
    """An engine, told the same setpoints for a while, and what was seen of it."""

    def __init__(self, place, **choice):
        self.engine = Planar(**choice).build(place)
        self.kinds, self.rows = place.kinds, len(place.kinds)
        self.t = 0.0
        self.path, self.touches = [], []

    def go(self, seconds, setpoint=None):
        for _ in range(round(seconds / DT)):
            if setpoint is not None:
                self.engine.command(np.array(setpoint, dtype=float))
            self.t += DT
            self.engine.advance(self.t, np.zeros((self.rows, 2)))
            self.path.append(self.engine.position.copy())
            self.touches += self.engine.touches()
        return self

    def aloft(self, position):
        """Everything that flies is put into the air."""
        flies = np.flatnonzero([kind.flies for kind in self.kinds])
        self.engine.place(flies, np.array(position, dtype=float), np.zeros(len(flies)), np.ones(len(flies), dtype=bool))
        return self

    def overlap(self, a, b):
        """The deepest of two rows in each other on the way [m]."""
        path = np.array(self.path)
        apart = np.linalg.norm(path[:, a, :2] - path[:, b, :2], axis=1)
        return (self.kinds[a].radius + self.kinds[b].radius - apart).max()


def still(rows):
    return np.zeros((rows, 4))
