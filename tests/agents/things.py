"""What rows know of themselves and of what is near, put together by hand."""

import numpy as np

from agents.arrays import PoseTable
from agents.body.kinds import KHEPERA4
from agents.plugins.avoidance import Nearby, OwnState


def own(kinds, position, *, yaw=0.0, velocity=0.0):
    """Rows of these kinds, at (N, 2) or (N, 3) [m]."""
    given = np.array(position, dtype=float).reshape(len(kinds), -1)
    place = np.zeros((len(kinds), 3))
    place[:, : given.shape[1]] = given
    takes = np.array([kind.takes for kind in kinds])
    column = {
        name: np.array([float(getattr(kind, name)) for kind in kinds])
        for name in ("radius", "height", "speed", "turn_rate", "response", "lag")
    }
    return OwnState(
        position=place,
        velocity=np.broadcast_to(np.asarray(velocity, dtype=float), place.shape).copy(),
        yaw=np.broadcast_to(np.asarray(yaw, dtype=float), len(kinds)).copy(),
        takes=tuple(takes.tolist()),
        by_position=takes == "position",
        by_twist=takes == "twist",
        flies=np.array([kind.flies for kind in kinds]),
        **column,
    )


def near(row, position, *, velocity=0.0, radius=0.0, heard=False, lag=0.0):
    """Things (K) that rows know, beside them all."""
    row = np.array(row, dtype=np.intp)
    many = len(row)
    place = np.array(position, dtype=float).reshape(many, 2)
    return Nearby(
        row=row,
        position=place,
        velocity=np.broadcast_to(np.asarray(velocity, dtype=float), place.shape).copy(),
        radius=np.broadcast_to(np.asarray(radius, dtype=float), many).copy(),
        low=np.zeros(many),
        high=np.full(many, KHEPERA4.height),
        is_robot=np.broadcast_to(np.asarray(heard), many).copy(),
        lag=np.broadcast_to(np.asarray(lag, dtype=float), many).copy(),
    )


NOTHING = near([], np.zeros((0, 2)))


def poses(link, position, velocity, stamp, arrival, *, yaw=None):
    """Poses received on links (H,)."""
    return PoseTable(link, np.zeros(len(link), dtype=np.intp), stamp, arrival, position, velocity, yaw)
