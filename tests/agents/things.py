"""A robot and what is near it, put together by hand."""

from agents.kinds.khepera4 import KHEPERA4
from agents.plugins.avoidance import Nearby, OwnState


def own(kind, position, *, yaw=0.0, velocity=(0.0, 0.0, 0.0)):
    """State of a robot of a kind, at x, y (, z) [m]."""
    made = OwnState()
    made.position = (*position, 0.0)[:3] if len(position) < 3 else tuple(position)
    made.velocity, made.yaw, made.flies = tuple(velocity), yaw, kind.flies
    made.radius, made.height, made.speed, made.lag = kind.radius, kind.height, kind.speed, kind.lag
    made.turn_rate, made.response = kind.turn_rate, kind.response
    made.by_position, made.by_twist = kind.takes == "position", kind.takes == "twist"
    return made


def near(*places, velocity=(0.0, 0.0), radius=0.0, is_robot=False, lag=0.0):
    """Things at x, y [m] that are alike otherwise."""
    made = Nearby()
    made.reserve(len(places))
    for x, y in places:
        thing = made.add()
        thing.x, thing.y, thing.radius, thing.lag, thing.is_robot = x, y, radius, lag, is_robot
        thing.velocity_x, thing.velocity_y = velocity
        thing.low, thing.high = 0.0, KHEPERA4.height
    return made


NOTHING = near()
