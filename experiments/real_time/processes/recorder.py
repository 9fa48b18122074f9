"""The recorder process: `python -m experiments.real_time.processes.recorder EXPERIMENT.json TARGET ...`.

A process of its own, so that a recording survives the conductor: it goes on until every robot is gone.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from math import isfinite, remainder, tau
from pathlib import Path
from typing import Annotated, Final

import msgspec
import zenoh

from agents.clock import Clock
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.messages import M
from agents.network.shutdown import AFTER_S, end
from agents.runtime import command_line
from agents.runtime.lifeline import event_in
from agents.ticks import POLL_S
from experiments.real_time.processes.joining import Launch, joined
from experiments.recording.topics import DEPTH, RARE, TOPICS, Message, Topic
from experiments.recording.writer import Recording
from experiments.scene import markers

FLUSH_S: Final = 1.0
FRESH_S: Final = 0.05  # largest time between a state and a true pose that belongs to it
PATIENCE_S: Final = 0.2  # longest wait of a state for the true pose after it
TRUTHS: Final = 256  # kept, of each robot
NAMED: Final = 100  # reported keys with unreadable messages
CDR: Final = "application/cdr"


class Recorder:
    def __init__(
        self, session: zenoh.Session, keys: Keys, recording: Recording, lines: deque[bytes] | None = None
    ) -> None:
        """Subscribe to all; `lines` are those of the lifeline, which may have events as well."""
        self._lines, self._events = deque[bytes]() if lines is None else lines, set[messages.Event]()
        self._keys, self._recording = keys, recording
        self._session = session
        self._utc = Clock().utc
        self.unread: dict[str, tuple[int, str]] = {}  # number by key, and why the last
        self._reported: dict[str, int] = {}
        self.alive: set[str] = set()  # tokens of the robots that are left
        self._inboxes = [(topic, self._inbox(self._subscribe(topic), topic.message)) for topic in TOPICS]
        self._world_events = self._inbox(pubsub.subscriber(session, keys.world_event, RARE), messages.Event)
        self._truths = self._inbox(pubsub.subscriber(session, keys.truth("*"), DEPTH), messages.Position)
        self._truth: dict[str, deque[messages.Position]] = {}
        # states that wait for truth: since when [s, monotonic], and the MIME types of their payloads
        self._queues: dict[str, deque[tuple[float, messages.State, str]]] = {}
        self._watch = pubsub.AliveWatch(session, keys.alive("*"))
        self._token = pubsub.alive_token(session, keys.recorder)

    def receive(self, *, last: bool = False) -> None:
        """Writes received messages; states of protocol twins wait for the next true pose, except the `last` time."""
        for token, stands in self._watch.changes():
            (self.alive.add if stands else self.alive.discard)(token)
        for truth in self._truths.read(_require_finite):
            self._store_truth(truth)
        for topic, inbox in self._inboxes:
            for message, sample in inbox.read_samples(_require_finite if topic.finite else None):
                self._store(message, sample)
        while self._lines:
            if (event := event_in(self._lines.popleft())) is not None:
                self._store_event(event)
        for event in self._world_events.read(validation.check_world_event):
            self._recording.write(event)
        now = time.monotonic()
        for robot, queue in self._queues.items():
            truths = self._truth[robot]
            while queue and (last or queue[0][1].stamp <= truths[-1].stamp or now - queue[0][0] > PATIENCE_S):
                _, state, mime = queue.popleft()
                self._recording.write(with_truth(state, truths), mime=mime)

    def report_malformed(self, *, last: bool = False) -> None:
        """Records unreadable messages as events: of each key the first, and their number the `last` time."""
        for key, (count, why) in list(self.unread.items())[:NAMED]:
            before = self._reported.get(key, 0)
            if not before or (last and count != before):
                self._reported[key] = count
                text = f"could not read {count} {'message' if count == 1 else 'messages'} on {key}: {why}"
                self._recording.write(messages.Event(self._utc(), "unread", "recorder", text))

    def _inbox(self, subscription: pubsub.Subscription, kind: type[M]) -> pubsub.Inbox[M]:
        keys = self._keys if "robot" in kind.__struct_fields__ else None
        return pubsub.Inbox(subscription, kind, keys=keys, on_refusal=self._note_unread)

    def _subscribe(self, topic: Topic) -> pubsub.Subscription:
        key = topic.key(self._keys)
        if not topic.repeated:
            return pubsub.subscriber(self._session, key, topic.depth)
        kept = pubsub.EVENTS if topic.message is messages.Event else 1
        return pubsub.pose_subscriber(self._session, key, topic.depth, kept)

    def _note_unread(self, key: str, reason: str) -> None:
        self.unread[key] = self.unread.get(key, (0, ""))[0] + 1, reason

    def _store(self, message: Message, sample: zenoh.Sample) -> None:
        mime = str(sample.encoding)
        if isinstance(message, messages.Event):
            self._store_event(message)
        elif isinstance(message, messages.State) and message.true_position is None and message.robot in self._truth:
            self._queues.setdefault(message.robot, deque()).append((time.monotonic(), message, mime))
        else:
            self._recording.write(message, sample.payload.to_bytes(), mime)

    def _store_event(self, event: messages.Event) -> None:
        """Stores an event that has not come on the other way."""
        if event not in self._events:
            self._events.add(event)
            self._recording.write(event)

    def _store_truth(self, truth: messages.Position) -> None:
        """Stores the true pose that a protocol twin publishes: its bridge cannot know it."""
        truths = self._truth.setdefault(truth.robot, deque(maxlen=TRUTHS))
        if truths and truth.stamp <= truths[-1].stamp:
            truths.clear()  # its device was started again
        truths.append(truth)


def _require_finite(message: msgspec.Struct) -> None:
    if not _finite(message):
        raise messages.Malformed("a number is not finite")


def _finite(value: object) -> bool:
    """Whether all numbers of a message are finite."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple | list):
        return all(map(_finite, value))
    return not isinstance(value, float) or isfinite(value)


def with_truth(state: messages.State, truths: Sequence[messages.Position]) -> messages.State:
    """A state with the true pose of its robot: interpolated between the true poses (in order of time) before and after.

    With only one, that one if it is fresh; unchanged without any.
    """
    after = next((truth for truth in truths if truth.stamp >= state.stamp), None)
    before = next((truth for truth in reversed(truths) if truth.stamp <= state.stamp), None)
    near = [each for each in (before, after) if each is not None and abs(each.stamp - state.stamp) < FRESH_S]
    if not near:
        return state
    one, other = near[0], near[-1]
    share = (state.stamp - one.stamp) / (other.stamp - one.stamp) if other.stamp > one.stamp else 0.0
    x, y, z = (a + share * (b - a) for a, b in zip(one.position, other.position, strict=True))
    yaw = one.yaw
    if one.yaw is not None and other.yaw is not None:
        yaw = messages.heading(one.yaw + share * remainder(other.yaw - one.yaw, tau))
    return msgspec.structs.replace(state, true_position=(x, y, z), true_yaw=yaw)


class RecorderLaunch(Launch, frozen=True, kw_only=True, rename="kebab"):
    """Records one case of an experiment, from its file as `./zenpark run` resolved it."""

    target: Annotated[str, msgspec.Meta(description="the recording")]
    name: Annotated[str, msgspec.Meta(description="of the case, for the recording")] = ""
    source: Annotated[str, msgspec.Meta(title="FILE", description="the experiment file to attach")] = ""


def record(launch: RecorderLaunch) -> int:
    """Records one case until its lifeline is lost and the robots are gone, or until SIGTERM; returns the exit code."""
    plan, endpoints = launch.read()
    text = Path(launch.source).read_text("utf-8")
    lost, asked = threading.Event(), threading.Event()
    lines = deque[bytes]()
    target, seed = Path(launch.target), plan.experiment.seed
    with (
        joined(
            plan, endpoints, name="recorder", stop=asked, on_signal=asked.set, lost=lost, on_line=lines.append
        ) as joint,
        Recording(
            target,
            plan,
            text,
            case=launch.name,
            seed=seed,
            clock="real",
            draw=markers.drawing(plan),
            show=pubsub.publisher(joint.session, joint.keys.scene, CDR).put,
            utc=Clock().utc,
        ) as recording,
    ):
        recorder = Recorder(joint.session, joint.keys, recording, lines)
        joint.declared.append(recorder)
        router = network.RouterWatch(joint.session, joint.keys.recorder, endpoints)
        flush_at = time.monotonic() + FLUSH_S
        last = float("inf")
        while not asked.wait(POLL_S):
            recorder.receive()
            now = time.monotonic()
            router.silent_since(now)
            if now > flush_at:
                recorder.report_malformed()
                recording.flush()
                flush_at = now + FLUSH_S
            if lost.is_set():
                last = min(last, now + AFTER_S)
                if not recorder.alive or now > last or not network.connected(joint.session):
                    break
        recorder.receive(last=True)
        recorder.report_malformed(last=True)
    return 0


if __name__ == "__main__":
    end(lambda: command_line.run("zenpark recorder", RecorderLaunch, record, more=(OSError,)))
