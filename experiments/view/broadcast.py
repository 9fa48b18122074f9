"""A recording played onto the network: keys and payloads as flown, for every tool that looks at a run.

The replay owns the names of its robots (`agents.network.name_ownership`): a robot that starts is refused, and the
replay ends as soon as another process owns one of them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import zenoh

from agents.clock import Clock
from agents.errors import ExplainedError
from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.network.name_ownership import NameTaken, OwnershipCheck, claim
from experiments.file import document
from experiments.recording.playback import AboutRun, topic_of
from experiments.recording.reader import RecordingError, Records
from experiments.recording.ros2 import payload
from experiments.recording.topics import Topic
from experiments.view.replay import ReplayClock

STEP_S: Final = 0.01
SEEN_S: Final = 1.0  # time until the tokens of a run that is up have come


class Broadcast:
    """The messages of one recording, in order of time, on the network."""

    def __init__(self, session: zenoh.Session, path: Path, realm: str | None = None, watch_s: float = SEEN_S) -> None:
        """Reads the recording; its keys begin with `realm`, or with that of the run.

        `watch_s` is how long it looks for others in the realm before it plays.
        """
        records = Records(path)
        topics: dict[int, tuple[Topic, messages.Encoding] | None] = {}  # topics and encodings by channel
        self._sent: list[tuple[int, int, bytes]] = []  # log time [ns], channel, data
        for message in records.messages():
            if message.channel not in topics:
                topics[message.channel] = topic_of(records, message.channel)
            if topics[message.channel] is not None:
                self._sent.append((message.logged, message.channel, message.data))
        self._topics = {channel: found for channel, found in topics.items() if found is not None}
        self._channels = records.channels
        self._sent.sort(key=lambda each: each[0])
        about = AboutRun.of(records)
        self.plan, self.case = about.plan, about.case
        if not self._sent:
            raise RecordingError(f"{path}: holds no message; there is nothing to replay")
        self._watch_s = watch_s
        self._session, self.keys = session, Keys(realm or self.plan.experiment.network.realm)
        self.begin, self.end = self._sent[0][0] * 1e-9, self._sent[-1][0] * 1e-9  # [s, UTC]
        self._publishers: dict[str, Any] = {}
        self._declared: list[object] = []

    def run(self, ended: threading.Event, clock: ReplayClock, endpoints: Sequence[str] = ()) -> int:
        """Plays until `ended`, by a clock from 0 to the recording's length [s]; returns the number of messages sent.

        Raises ExplainedError if a run or a robot is up in the realm, before or while it plays.
        """
        keys, names = self.keys, [self.keys.alive(name) for name in self.plan.names]
        began, zid = Clock().utc(), str(self._session.zid())
        owners = Keys.life(keys.alive("*"), "*")
        watched = (keys.conductor, keys.alive("*"), owners, keys.world_alive)
        watches = [pubsub.AliveWatch(self._session, key) for key in watched]
        self._declared += watches

        def refuse_strangers(own: Sequence[str] = ()) -> None:
            found = {token for watch in watches for token, stands in watch.changes() if stands}
            if strangers := {token for token in found if token not in own and Keys.life_of(token) != zid}:
                raise ExplainedError(_occupied(keys, strangers))

        until = time.monotonic() + self._watch_s
        while time.monotonic() < until and not ended.wait(STEP_S):
            refuse_strangers()
        count = at = 0
        if ended.is_set():
            return count
        ownership = OwnershipCheck(names)
        try:
            self._declared.append(claim(self._session, names, began=began, endpoints=endpoints, stop=ended))
            announced = pubsub.pose_publisher(self._session, keys.experiment, messages.JSON)
            announced.put(document.case_document(self.plan, self.case))
            self._declared += [announced, *(pubsub.alive_token(self._session, token) for token in names)]
            last, now = clock.t, time.monotonic()
            while not ended.wait(STEP_S):
                ownership.wait_while_checking(self._session, ended.is_set)
                refuse_strangers(names)
                now, before = time.monotonic(), now
                clock.advance(now - before)
                if clock.t < last:
                    at = 0  # the loop begins again
                last = clock.t
                while at < len(self._sent) and self._sent[at][0] * 1e-9 - self.begin <= clock.t:
                    self._send(*self._sent[at][1:])
                    at, count = at + 1, count + 1
                if at >= len(self._sent) and not clock.loop:
                    break
        except NameTaken as taken:
            raise ExplainedError(_occupied(keys, set(str(taken).split(", ")))) from None
        finally:
            ownership.end()
        return count

    def _send(self, channel: int, data: bytes) -> None:
        topic, encoding = self._topics[channel]
        robot = self._channels[channel].topic.removeprefix("/").partition("/")[0]
        key, mime = topic.key(self.keys).replace("*", robot), messages.MIME[encoding]
        publisher = self._publishers.get(key)
        if publisher is None:
            kept = pubsub.EVENTS if topic.message is messages.Event else 1
            publisher = self._publishers[key] = (
                pubsub.pose_publisher(self._session, key, mime, kept)
                if topic.repeated
                else pubsub.publisher(self._session, key, mime)
            )
        with suppress(messages.Malformed):
            publisher.put(payload.unwrap(data, encoding))


def _occupied(keys: Keys, tokens: set[str]) -> str:
    shown = sorted({token.partition("/life/")[0] for token in tokens})[:3]
    return (
        f"in the realm '{keys.realm}' a run is up ({', '.join(shown)}): robots would take the recording "
        "for their neighbours; name another realm (--realm replay), or wait for its end"
    )
