"""Neighbours of one robot: received poses, liveliness, and which links enter its law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite, nan
from typing import ClassVar, Final

import msgspec

from agents.body.kinds import Kind
from agents.formation.changes import Target
from agents.formation.link import Link
from agents.plugins.predictors import Predictor
from agents.vectors import UNKNOWN, ZERO, Vector, difference

NO_WORDS: Final[Mapping[str, tuple[float, ...]]] = {}


class Incoming(msgspec.Struct, frozen=True):
    """A link on which a robot receives poses, as the experiment has it."""

    sender: int  # number among all robots of the experiment
    name: str  # name of the sender
    kind: Kind  # kind of the sender
    distance: float  # target and gain, see `Link`
    gain: float = 1.0
    relative: Vector = UNKNOWN
    bearing: Vector = UNKNOWN
    wants: int = 0
    in_law: bool = True  # else the poses are for avoidance alone
    awaited: bool = True  # the robot is not ready without a pose of this sender
    targets: tuple[Target, ...] = ()  # targets after each change of the formation
    since: float = -inf  # time after the common start at which the link begins [s],
    until: float = inf  # time at which that change ends [s]
    reach: float = inf  # distance below which it begins [m]; infinity: any
    release: float = inf  # distance above which it ends [m]; the gap to `reach` prevents flicker


class Neighbour:
    """Sender of one link: its target, its last pose, and its liveliness."""

    NAMED: ClassVar = ("said",)

    def __init__(self, incoming: Incoming, unsaid: Mapping[str, tuple[float, ...]] = NO_WORDS) -> None:
        self.sender, self.name = incoming.sender, incoming.name
        self.radius, self.height, self.lag = incoming.kind.radius, incoming.kind.height, incoming.kind.lag
        self.in_law, self.awaited, self.targets = incoming.in_law, incoming.awaited, incoming.targets
        self.since, self.until = incoming.since, incoming.until
        self.reach, self.release = incoming.reach, incoming.release
        # its target now
        self.link = Link(incoming.distance, incoming.gain, incoming.relative, incoming.bearing, incoming.wants)
        self.position = UNKNOWN  # last received [m], NaN before; of a former process until its successor has sent one
        self.velocity = ZERO  # [m/s]
        self.yaw = nan  # [rad], NaN where unknown
        self.said = unsaid  # variables beside its last pose, by name; NaN where unknown
        self.stamp = -inf  # time of measurement, limited to plausible values [s]; −inf before the first pose
        self.arrival = -inf  # time of reception [s]
        self.lost_since = -inf  # its loss [s]; inf: alive; −inf: token never seen, a pose is no sign of life
        self.available = False  # pose received, sender not lost for long
        self.present = incoming.in_law  # part of the formation now
        self.active = False  # enters the law
        self.behind = 0.0  # age of its poses on arrival where its clock lags [s], else 0
        self.doubt = ""  # why all its poses are refused; empty: they are not
        self.foreign = 0  # poses from another source than the sender

    @property
    def silent(self) -> bool:
        """Whether only its last place is known: it is lost, or restarted and without a pose since."""
        return self.lost_since < inf or self.stamp == -inf

    def apart(self, position: Vector, predictor: Predictor, t: float) -> Vector:
        """p_i − p̂_j: a robot's `position` less the believed one of this sender at `t` [s]."""
        return difference(position, predictor.position(self, t - self.stamp))

    def place(self, predictor: Predictor, t: float) -> Vector:
        """Believed position at `t` [s], NaN before the first pose; a lost sender stopped where it was at its loss."""
        if self.stamp == -inf:
            return predictor.position(self, 0.0)
        if self.lost_since < inf:
            return predictor.position(self, max(0.0, min(t, self.lost_since) - self.stamp))
        return predictor.position(self, t - self.stamp)


class Neighbours:
    """All senders of one robot."""

    def __init__(self, incoming: Sequence[Incoming], silence_s: float, says: Mapping[str, int] | None = None) -> None:
        """Start without poses; lost senders leave the law after `silence_s` [s].

        Args:
            says: Sizes of the variables beside poses that the law knows.
        """
        self._unsaid = {name: (nan,) * size for name, size in (says or {}).items()}
        self.all = [Neighbour(each, self._unsaid) for each in incoming]  # same order as the links
        self.incomplete = True  # a sender is missing or lost, so that time alone can change the active links
        self.lagging = False  # the clock of a sender lags
        self.refused = False  # all poses of a sender are refused
        self.foreign_at = -inf  # time of the last pose from another source than its sender [s]
        self.silence_s = silence_s

    def receive(
        self, link: int, position: Vector, velocity: Vector, stamp: float, arrival: float,
        *, yaw: float = nan, said: Mapping[str, tuple[float, ...]] = NO_WORDS,
    ) -> bool:  # fmt: skip
        """Store a pose of the sender on a link, if it is newer than the known one; returns whether it is.

        `said` are the variables that came with it, by name.
        """
        sender = self.all[link]
        if not stamp > sender.stamp:
            return False
        sender.position, sender.velocity, sender.stamp, sender.arrival = position, velocity, stamp, arrival
        sender.yaw = yaw
        self.hear(link, said)
        return True

    def hear(self, link: int, said: Mapping[str, tuple[float, ...]]) -> None:
        """Store the variables beside the last pose: NaN for those left out, or of another size than the law's."""
        unsaid = self._unsaid
        if unsaid:
            fit = {name for name, nothing in unsaid.items() if len(said.get(name, ())) == len(nothing)}
            unsaid = {name: said[name] if name in fit else nothing for name, nothing in unsaid.items()}
        self.all[link].said = unsaid

    def mark_lost(self, link: int, t: float) -> None:
        """Liveliness token of the sender lost at `t` [s]."""
        sender = self.all[link]
        sender.lost_since = min(sender.lost_since, t)
        self.incomplete = True

    def mark_alive(self, link: int) -> None:
        """Liveliness token of the sender seen, whether or not poses follow."""
        self.all[link].lost_since = inf
        self.incomplete = True

    def discard_pose(self, link: int) -> None:
        """Discard the pose of a sender that was restarted: it stands where it was last."""
        sender = self.all[link]
        sender.velocity = ZERO
        sender.stamp, sender.arrival = -inf, -inf
        sender.yaw, sender.said = nan, self._unsaid
        self.incomplete = True

    def mark_clock_lag(self, link: int, lag: float) -> None:
        """The clock of the sender lags: its poses are `lag` [s] old on arrival; 0: no longer."""
        self.all[link].behind = lag
        self.lagging = any(sender.behind > 0.0 for sender in self.all)

    def mark_refused(self, link: int, reason: str) -> None:
        """All poses of the sender are refused for a `reason`; empty: they are not, or no longer."""
        self.all[link].doubt = reason
        self.refused = any(sender.doubt for sender in self.all)

    def mark_foreign(self, link: int, count: int, t: float) -> None:
        """Poses of the sender came from another source until `t` [s], `count` so far."""
        self.all[link].foreign, self.foreign_at = count, t

    def missing(self) -> list[str]:
        """Senders that were never received, or are lost."""
        return [sender.name for sender in self.all if not isfinite(sender.stamp) or sender.lost_since < inf]

    def unreceived(self) -> bool:
        """Whether a pose of an awaited sender that was alive once is still missing."""
        return any(sender.awaited and (sender.lost_since == -inf or not isfinite(sender.stamp)) for sender in self.all)

    def update_active(self, t: float) -> bool:
        """Update the active links at `t` [s]; returns whether they changed."""
        complete = True
        for sender in self.all:
            known = isfinite(sender.stamp)
            complete = complete and known and sender.lost_since == inf
            sender.available = known and t - sender.lost_since <= self.silence_s
        self.incomplete = not complete
        return self.select()

    def select(self) -> bool:
        """Let available links that are present enter the law; returns whether that changed anything."""
        changed = False
        for sender in self.all:
            active = sender.available and sender.present
            changed = changed or active != sender.active
            sender.active = active
        return changed
