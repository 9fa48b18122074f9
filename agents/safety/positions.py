"""Belief in measured positions: a robot does not jump.

A position that jumps comes from something else now (swapped markers, another origin), or the robot was put somewhere by
hand. One that is not believed reaches neither the decision nor, where it is measured from outside, the robot itself.
All of it runs on quiet ticks.
"""

from __future__ import annotations

from math import inf, isfinite, isnan, nan, pi, remainder, sqrt, tau
from typing import Final

from agents.body.kinds import Kind
from agents.vectors import UNKNOWN, Vector, clamp

JUMP_M: Final = 0.5  # [m] excess over what a robot can move between two measurements: it is not where its position says
GAP_S: Final = 0.5  # longest time that counts between them; after a longer one it stood, or was landed
PLAUSIBLE_SPEED: Final = 1.5  # share of a kind's speed: what it can move
FLIP: Final = 0.5  # [rad] excess over what a robot can turn between two measurements: its markers are mistaken
ABSURD: Final = 1e6  # [rad] no yaw
MOST_TURNED: Final = 1.2  # [rad] largest turn between two measurements, however long the time between them


class Continuity:
    """Jumps of the measured position of a robot, and, on wheels, of its yaw, by which it drives.

    It has jumped until its position is back, or until it is forgotten: an outlier lasts a sample.
    """

    def __init__(self, kind: Kind, jump_m: float = JUMP_M) -> None:
        """A jump is longer than `jump_m` [m]."""
        self.jumped = False  # it has jumped
        self.yaw_jump = nan  # size of the jump of its yaw [rad]; NaN: it did not jump
        self._jump_m, self._squared = jump_m, jump_m * jump_m
        self._fastest = PLAUSIBLE_SPEED * kind.speed  # largest speed that it can have [m/s]
        self._turn_rate = PLAUSIBLE_SPEED * kind.turn_rate  # largest turn rate that it can have [rad/s]
        self._wheels = kind.takes == "twist"
        self._place, self._time = UNKNOWN, 0.0  # last plausible position [m], NaN: none, and its time [s]
        self._yaw = nan  # last plausible yaw [rad], NaN: none

    def jump(self, time: float, position: Vector, yaw: float, watched: bool) -> float:
        """Length [m] of the jump of the robot, or NaN.

        The `position` [m] and `yaw` [rad] were measured at `time` [s]. A jump of the yaw counts as well. A robot that
        is not `watched`, not in motion, may be carried; it restarts unless it has jumped.
        """
        (x, y, z), (last_x, last_y, last_z) = position, self._place
        x, y, z = x - last_x, y - last_y, z - last_z
        squared = x * x + y * y + z * z
        if watched and squared < self._squared and (not self._wheels or abs(yaw - self._yaw) < FLIP):
            self._place, self._time = position, time
            if self._wheels:
                self._yaw = yaw
            if self.jumped:
                self.jumped, self.yaw_jump = False, nan
            return nan
        return self._weigh(time, position, yaw, watched or self.jumped, sqrt(squared))

    def _weigh(self, time: float, position: Vector, yaw: float, watched: bool, gap: float) -> float:
        """`jump` of a position that is `gap` [m] from the last one, at length."""
        elapsed = time - self._time
        since = clamp(elapsed, 0.0, GAP_S) if isfinite(elapsed) else 0.0
        plausible, plausible_turn = self._jump_m, FLIP
        if not self.jumped:
            plausible += self._fastest * since
            plausible_turn += self._turn_rate * since
        turn = abs((yaw - self._yaw + pi) % tau - pi) if self._wheels and isfinite(yaw) else nan  # NaN: none before
        turned = watched and turn > plausible_turn
        blind = watched and (isnan(position[0]) or isnan(position[1]) or isnan(position[2]))
        self.yaw_jump = turn if turned else nan
        self.jumped = turned or (watched and (gap > plausible or (blind and self.jumped)))
        if self._wheels and not self.jumped and (isfinite(yaw) or not watched):
            self._yaw = yaw
        if not (self.jumped or blind):
            self._place, self._time = position, time
        return gap if self.jumped else nan

    def forget(self) -> None:
        """The robot is where its position says, wherever that is, and its yaw is right."""
        self._place, self._yaw = UNKNOWN, nan
        self.jumped = False


class ExternalPositions:
    """Plausibility of externally measured positions of a robot, sample by sample.

    A moving robot has jumped if it moved by more than its own size beyond its possible travel. Two robots that are
    mistaken for each other are at least that distance apart. Smaller errors show as disobedience.
    """

    def __init__(self, kind: Kind) -> None:
        self.jump = nan  # length of its jump [m]; NaN: it did not jump
        self.deceived = False  # its positions are wrong for good
        self.doubted = False  # its position is not believed
        # where it is measured [m] while that is not believed because it disobeys; NaN: nowhere, or it has jumped
        self.place = UNKNOWN
        self._disobeys = False  # it is not believed because of that
        self._continuity = Continuity(kind, 2.0 * kind.radius)
        self._time = -inf  # time of the last position [s]
        self._turn_rate = PLAUSIBLE_SPEED * kind.turn_rate  # largest turn rate that it can have [rad/s]
        self._yaw = self._yaw_time = nan  # last measured [rad], and when [s]
        self._flipped = 0.0  # sum of the jumps of the yaw [rad]

    def believes(self, time: float, position: Vector, *, watched: bool) -> bool:
        """Whether the robot is at `position` [m], measured at `time` [s]; older ones than before are left out.

        `watched`: it is in motion. At rest it may be carried.
        """
        if time <= self._time:
            return False
        self._time = time
        if not watched:
            self.deceived = self._disobeys = False
            self._continuity.forget()
        self.jump = self._continuity.jump(time, position, 0.0, watched)
        self.doubted = self.deceived or not isnan(self.jump)
        self.place = position if self._disobeys and isnan(self.jump) else UNKNOWN
        return not (self.deceived or self._continuity.jumped)

    def believed_yaw(self, time: float, yaw: float, *, watched: bool) -> float:
        """The `yaw` [rad] that is measured at `time` [s]; NaN while it is known to be wrong.

        Markers that look the same when turned make it flip; it is wrong until it has flipped back.
        """
        if not abs(yaw) < ABSURD:  # NaN is not smaller either
            return nan
        jump, since = remainder(yaw - self._yaw, tau), time - self._yaw_time
        if not watched:
            self._flipped = 0.0
        elif abs(jump) > min(FLIP + self._turn_rate * since, MOST_TURNED):  # not of the first one, which is NaN
            self._flipped = remainder(self._flipped + jump, tau)
        self._yaw, self._yaw_time = yaw, time
        return yaw if abs(self._flipped) < FLIP else nan

    def disbelieve(self) -> None:
        """Reject external positions while the robot is in motion; without a jump, because it disobeys."""
        if self._time > -inf:
            self._disobeys = self._disobeys or (isnan(self.jump) and not self.deceived)
            self.deceived = self.doubted = True

    def forget(self) -> None:
        """The robot is where its position says, wherever that is."""
        self._continuity.forget()
        self.jump, self.doubted = nan, self.deceived
