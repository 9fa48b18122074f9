"""Order of the poses of one robot: which source is the robot, and which poses are newer than the known ones. Pure."""

from __future__ import annotations

from typing import Literal

# Result of the comparison of a pose with the last one. `anew`: first of another process, or of a clock that was set
# back, so that earlier poses are void; `repeated`: the last one again, after a reconnection.
Freshness = Literal["next", "anew", "old", "repeated"]


class PoseOrder:
    """Session, number and stamp of the last pose of a robot.

    A process shows its session by a life token (`agents.network.name_ownership`). While one is there no other source is
    the robot, and of several the first stays: the process of a later one has to give way. Robots of other makes have
    none. Their sessions may change, and their poses need not name one.
    """

    def __init__(self) -> None:
        self.seq, self.stamp = 0, 0.0  # number and stamp of the last pose; 0: none of this session
        self._session: str | None = None  # session of the robot, as far as it is known
        self._named = False  # True if that session had a life token
        self._lives: list[str] = []  # sessions with a life token, the first one first

    def note_life(self, session: str, *, stands: bool) -> bool:
        """The life token of `session` appeared, or vanished; returns whether the robot has a new session."""
        self._lives = [life for life in self._lives if life != session] + ([session] if stands else [])
        if not self._lives:
            return False
        known, self._named = self._named or self.seq > 0, True
        if self._session in self._lives:
            return False
        self._session = self._lives[0]
        self.seq, self.stamp = 0, 0.0
        return known

    def return_token(self) -> bool:
        """The plain token of the robot is back; returns whether the robot has a new session."""
        if self._lives:
            return False
        if self._named:  # a robot of another make may have taken the name
            self._named = False
            return False
        known = self._session is None and self.stamp > 0.0
        self.seq, self.stamp = 0, 0.0
        return known

    def is_foreign(self, session: str | None) -> bool:
        """Whether a pose from `session`, None if it names none, comes from another source than the robot."""
        return session != self._session and bool(self._lives or (self._named and session is None))

    def compare(self, session: str | None, seq: int, stamp: float) -> Freshness:
        """Compare a pose from a source that is not foreign, and store it if it is newer."""
        other = session is not None and session != self._session
        if stamp <= self.stamp and (other or seq <= self.seq or (session is None and self._session is not None)):
            return "repeated" if stamp == self.stamp else "old"
        anew = stamp <= self.stamp or (other and self._session is not None)
        if other:
            self._session = session
        self.seq, self.stamp = seq, stamp
        return "anew" if anew else "next"
