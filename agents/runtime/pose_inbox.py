"""Reception of the neighbours' poses, through the modelled channel, and liveliness of the neighbours."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from math import inf, nan
from typing import Final, Literal, Protocol

import msgspec
import zenoh

from agents.decision.neighbours import NO_WORDS
from agents.network import messages, pubsub, validation
from agents.network.channel_model import Channel, Conditions
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime.pose_order import PoseOrder

LATE_S: Final = 3.0  # longest delay of a pose in a network: Zenoh holds one back for 2 s behind a missing one
PROOFS: Final = 3  # late poses in succession that prove a slow clock: one may be the last value of a silent robot
DOUBT_S: Final = 0.5  # time in which all poses of a robot are refused before the robot counts as lost


# of the liveliness of a robot; "new session": its process is another one than before
TokenChange = Literal["appeared", "vanished", "new session"]


class ReceivedPose(msgspec.Struct, frozen=True):
    """A valid pose that is newer than those before it."""

    pose: messages.Pose
    size: int  # [bytes] length of its payload
    missed: int  # lost poses before it
    # [s] UTC of the measurement, as far as its stamp can be true: not after its arrival, and, if the clock of the robot
    # is behind, not longer before it than a network delays poses
    measured: float
    anew: bool  # first pose of a new session of the robot: earlier knowledge is void


class NeighbourSubscription:
    """Subscription to one robot: drops duplicates, counts losses, tracks liveliness."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        name: str,
        links: Sequence[int],
        *,
        valid_box: messages.Vector,
        rate: float,
        depth: int = pubsub.POSES,
        bell: pubsub.Bell | None = None,
    ) -> None:
        """Subscribes to the robot `name`, the sender on `links`.

        `valid_box` has the largest |x|, |y|, |z| of a valid pose [m], `rate` is the largest rate of its poses [1/s]. At
        most `depth` of them may wait; each rings the `bell`, if there is one.
        """
        self.name, self.links, self._valid_box, self._rate = name, links, valid_box, rate
        key = keys.pose(name)
        subscription = pubsub.pose_subscriber(session, key, depth, bell=bell)
        self._poses = pubsub.Inbox(subscription, messages.Pose, keys=keys)
        self.take = self._poses.take  # the next queued sample, or None
        self._token = keys.alive(name)
        self._alive = pubsub.AliveWatch(session, keys.lives(self._token))
        self.tokens = self._alive.queue  # queued for `token_changes`, nearly always none
        self._order = PoseOrder()
        self.alive: bool | None = None  # its plain token stands; None: never seen
        self._received_at = -inf  # last new pose (UTC [s])
        self._old, self._old_at = 0, 0.0  # how often in succession poses were old on arrival, and when last
        self.lost = 0  # poses; counted by the caller, which knows from when on they matter
        self.stale = 0  # poses that were dropped: older than a known one
        self.foreign = 0  # poses that were dropped: from another source than the robot's process
        self.doubt = ""  # reason of the last refusal while all poses of the robot are refused; else empty
        self._refused, self._refusals, self._refused_since = 0, 0, 0.0
        # [s] age of the last pose on arrival if the clock of the robot is behind: the last poses were older than the
        # longest delay of a network; else 0
        self.behind = 0.0

    @property
    def malformed(self) -> int:
        return self._poses.malformed + self._refused

    def new_poses(self, first: zenoh.Sample, now: float) -> Iterator[ReceivedPose]:
        """Poses received until `now` (UTC [s]), oldest first, without invalid, foreign and known ones.

        `first` is the first queued sample. A new session of the robot resets the order of poses, as does a clock that
        was set back in one session.
        """
        before = self._received_at  # poses that waited while this process stood still count as one reception
        order = self._order
        for pose, sample in self._poses.read_from(first):
            session = pubsub.session_of(sample)
            if order.is_foreign(session):
                self.foreign += 1
                continue
            try:
                validation.check_pose(pose, now=now, valid_box=self._valid_box)
            except messages.Malformed as error:
                self._note_refusal(now, str(error))
                continue
            seq, stamp = order.seq, order.stamp
            news = order.compare(session, pose.seq, pose.stamp)
            if news in {"old", "repeated"}:
                self.stale += news == "old"
                continue
            age, missed = now - pose.stamp, 0
            if age > LATE_S or self._old:
                self._detect_lag(now, age)
            if news == "next" and seq and pose.seq != seq + 1:
                missed = validation.missed(seq, pose.seq, pose.stamp - stamp, self._rate)
            # A clock that is behind: a predictor must not extrapolate over that time. A pose from before the last
            # reception, too late for a network, proves it at once; the first pose ever may be that of a silent robot.
            slow = self.behind or (pose.stamp < before and age > LATE_S)
            measured = now - LATE_S if slow else validation.taken(pose.stamp, now)
            self._received_at = now
            self._refusals, self.doubt = 0, ""
            yield ReceivedPose(pose, len(sample.payload), missed, measured, news == "anew")

    def _note_refusal(self, now: float, reason: str) -> None:
        """Counts a refused pose of the robot; after several in succession, for long, the robot is in doubt."""
        self._refused += 1
        self._refusals += 1
        if self._refusals == 1:
            self._refused_since = now
        if self._refusals >= PROOFS and now - self._refused_since > DOUBT_S:
            self.doubt = reason

    def token_changes(self) -> Iterator[TokenChange]:
        """Changes of the liveliness of the robot, oldest first."""
        for token, stands in self._alive.changes():
            if token == self._token:
                if stands and self.alive is False and self._order.return_token():
                    yield "new session"
                self.alive = stands
                self._refusals, self.doubt = 0, ""
                yield "appeared" if stands else "vanished"
            elif (session := Keys.life_of(token)) is not None and self._order.note_life(session, stands=stands):
                yield "new session"

    def _detect_lag(self, now: float, age: float) -> None:
        """Detects a clock that is behind, from the `age` [s] of poses on arrival."""
        if age <= LATE_S:
            self._old, self.behind = 0, 0.0
        elif now > self._old_at:  # poses that waited while this process stood still arrive at once, and count once
            self._old, self._old_at = self._old + 1, now
            self.behind = age if self._old >= PROOFS else 0.0


MAX_UNREPORTED: Final = 20_000  # poses that wait for telemetry, which empties them several times a second: 10 MB


class Knowledge(Protocol):
    """Recipient of what an inbox learns of the sender on a link, by the number of the link there."""

    def mark_alive(self, link: int) -> None: ...

    def mark_lost(self, link: int, t: float) -> None: ...

    def discard_pose(self, link: int) -> None: ...


Arrived = tuple[int, float, ReceivedPose]  # link, arrival [s], pose


class ModelledInbox:
    """Poses of several robots through the modelled channel, and their liveliness; polled."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        links: Mapping[str, Sequence[int]],  # links of each sender
        conditions: Sequence[Conditions],  # effects of the modelled channel on each link
        knowledge: Sequence[tuple[Knowledge, int]],  # recipient of each link, and its number there
        *,
        valid_box: messages.Vector,
        rate: float,
        depth: int = pubsub.POSES,
        bell: pubsub.Bell | None = None,
        counted: Callable[[float], bool] = lambda _: True,
    ) -> None:
        """Subscribes to all senders; see `NeighbourSubscription`.

        `counted` tells whether a pose of that stamp [s] matters, so that those lost before it count.
        """
        self._knowledge, self._channel = knowledge, Channel(conditions)
        self._counted = counted
        self.senders = [
            NeighbourSubscription(session, keys, name, effects, valid_box=valid_box, rate=rate, depth=depth, bell=bell)
            for name, effects in links.items()
        ]
        self.arrived = 0  # poses before the modelled channel, without those of robots of this process
        self.changed = False  # a sender appeared or vanished since the caller reset this
        self.heard = False  # the last call of `receive` took a sample, accepted or not
        self._doubted = [False] * len(self.senders)

    @property
    def dropped(self) -> list[int]:
        """Samples that the channel dropped on each link."""
        return self._channel.dropped

    @property
    def malformed(self) -> int:
        return sum(sender.malformed for sender in self.senders)

    def receive(
        self, t: float, utc: float, start: Callable[[int], float], own: Collection[str] = ()
    ) -> Sequence[Arrived]:
        """Poses that got through until `t` [s] of a clock that was 0 at `utc` [s].

        `start` tells a modelled channel the common start of the receiver on a link [s], `own` are robots of this
        process.
        """
        self.heard = False
        for sender in self.senders:
            for change in sender.token_changes() if sender.tokens else ():
                self.changed = self.heard = True
                self._note_change(sender, change, t)
        now, arrived = utc + t, list[Arrived]()
        for sender in self.senders:
            if (first := sender.take()) is None:
                continue
            self.heard = True
            for received in sender.new_poses(first, now):
                if received.missed and self._counted(received.pose.stamp - utc):
                    sender.lost += received.missed
                self.arrived += sender.name not in own
                if received.anew:
                    self._begin(sender)
                    arrived = [each for each in arrived if each[0] not in sender.links]
                arrived += [(link, t, received) for link in sender.links]
        if self.heard:
            self._follow_doubts(t)
        channel = self._channel
        if channel.ideal:
            return arrived
        for link, _, received in arrived:
            pose = received.pose
            channel.send(link, received, pose.seq, pose.stamp - utc, start=start(link), size=received.size, now=t)
        return channel.due(t)

    def _note_change(self, sender: NeighbourSubscription, change: TokenChange, t: float) -> None:
        if change == "new session":
            self._begin(sender)
            return
        for link in sender.links:
            knowledge, number = self._knowledge[link]
            if change == "appeared":
                knowledge.mark_alive(number)
            else:
                self._channel.forget(link)
                knowledge.mark_lost(number, t)

    def _follow_doubts(self, t: float) -> None:
        """A sender of which no pose can be believed is lost, although its token stands."""
        if (doubted := [bool(sender.doubt) for sender in self.senders]) == self._doubted:
            return
        for sender, doubt, before in zip(self.senders, doubted, self._doubted, strict=True):
            for knowledge, number in (self._knowledge[link] for link in sender.links):
                if doubt and not before:
                    knowledge.mark_lost(number, t)
                elif before and not doubt and sender.alive:
                    knowledge.mark_alive(number)
        self._doubted, self.changed = doubted, True

    def _begin(self, sender: NeighbourSubscription) -> None:
        """Forgets a sender that has a new session."""
        for link in sender.links:
            self._channel.forget(link)
            knowledge, number = self._knowledge[link]
            knowledge.discard_pose(number)


class PoseInbox(ModelledInbox):
    """Poses of all neighbours of the robots of a process."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        robots: Sequence[Robot],
        *,
        valid_box: messages.Vector,
        conditions: Sequence[Sequence[Conditions]] = (),
        bell: pubsub.Bell | None = None,
    ) -> None:
        """Subscribes to the neighbours of `robots`, which get poses and losses.

        `valid_box` and `bell` as of `NeighbourSubscription`; `conditions` of each link of each robot, empty: an ideal
        network.
        """
        self._robots = robots
        self._own = {robot.assignment.name for robot in robots}
        # of each link: row of the robot that receives on it, and its number among that robot's links
        self._ends = [(row, k) for row, robot in enumerate(robots) for k in range(len(robot.neighbours.all))]
        links: dict[str, list[int]] = {}
        for link, (row, k) in enumerate(self._ends):
            links.setdefault(robots[row].neighbours.all[k].name, []).append(link)
        ideal = [Conditions()] * len(self._ends)
        first = robots[0].assignment
        super().__init__(
            session, keys, links, [each for own in conditions for each in own] or ideal,
            [(robots[row].neighbours, k) for row, k in self._ends],
            valid_box=valid_box, rate=first.body_hz / first.pose_every, bell=bell,
        )  # fmt: skip
        # (n) newest received poses of each robot, for telemetry, which empties them
        self.unreported = [deque[messages.PoseReceipt](maxlen=MAX_UNREPORTED) for _ in robots]
        self.received = [0] * len(robots)  # (n) received poses of each robot
        self._marks = [(0.0, "", 0)] * len(self.senders)

    def senders_of(self, row: int) -> list[NeighbourSubscription]:
        """Subscriptions of a robot."""
        return [sender for sender in self.senders if any(self._ends[link][0] == row for link in sender.links)]

    def dropped_of(self, row: int) -> dict[str, int]:
        """Samples that the modelled channel dropped on their way to a robot, by sender."""
        found = {}
        for (receiver, k), count in zip(self._ends, self.dropped, strict=True):
            if receiver == row and count:
                found[self._robots[row].neighbours.all[k].name] = count
        return found

    def deliver(self, t: float, utc: float) -> None:
        """Passes all poses until `t` [s] of a clock that was 0 at `utc` [s] to the robots and to telemetry."""
        got = self.receive(t, utc, self._start, self._own)
        if self.heard:
            self._mark([(sender.behind, sender.doubt, sender.foreign) for sender in self.senders], t)
        for link, arrival, received in got:
            pose = received.pose
            (row, k), velocity = self._ends[link], pose.velocity or messages.STILL
            yaw = nan if pose.yaw is None else pose.yaw
            said = {each.name: tuple(each.value) for each in pose.shared} if pose.shared else NO_WORDS
            self._robots[row].neighbours.receive(
                k, pose.position, velocity, received.measured - utc, arrival, yaw=yaw, said=said
            )
            self.unreported[row].append(
                messages.PoseReceipt(pose.robot, pose.seq, pose.stamp, utc + arrival, pose.position, velocity)
            )
            self.received[row] += 1

    def _mark(self, marks: list[tuple[float, str, int]], t: float) -> None:
        """Tell the robots what is wrong with poses of their neighbours, if that has changed."""
        if marks == self._marks:
            return
        for sender, (_, _, foreign) in zip(self.senders, self._marks, strict=True):
            for link in sender.links:
                row, k = self._ends[link]
                neighbours = self._robots[row].neighbours
                neighbours.mark_clock_lag(k, sender.behind)
                neighbours.mark_refused(k, sender.doubt)
                if sender.foreign > foreign:
                    neighbours.mark_foreign(k, sender.foreign, t)
        self._marks = marks

    def _start(self, link: int) -> float:
        return self._robots[self._ends[link][0]].lifecycle.start_at
