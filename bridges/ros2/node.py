"""A ROS 2 node made of a Zenoh session: publishers and subscribers of either style, polled, without ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import count
from typing import Final

import zenoh

from agents.clock import Clock
from agents.network import pubsub
from agents.network import session as network
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Message, Role, Style, Types


class Participant:
    """The ROS 2 side of one session; numbers its entities, as rmw_zenoh does.

    With "ros2dds", tokens belong to what plays the bridge between DDS and Zenoh (`announces`): it makes routes of them.
    """

    def __init__(
        self, session: zenoh.Session, types: Types, *, style: Style, domain: int = 0, announces: bool = False
    ) -> None:
        self.session: Final = session
        self.announces: Final = announces or style == "rmw"
        self.types: Final = types
        self.style: Final[Style] = style
        self.domain: Final = domain
        self.zid: Final = str(session.zid())
        self.clock: Final = Clock()
        self.numbers: Final = count()  # numbers of its entities

    def node(self, name: str, namespace: str = "") -> Node:
        """A node; namespace as in "tb3_0", without the leading slash."""
        return Node(self, name, namespace)


class Node:
    """A node and what it announces. Style "ros2dds" knows no nodes, only topics."""

    def __init__(self, participant: Participant, name: str, namespace: str) -> None:
        self.participant: Final = participant
        self.name, self.namespace = name, namespace
        self._number = next(participant.numbers)
        self._token: zenoh.LivelinessToken | None = None
        if participant.style == "rmw":
            key = ros2.node_token(participant.domain, participant.zid, self._number, namespace, name)
            self._token = pubsub.alive_token(participant.session, key)

    def publisher(self, topic: str, kind: str, quality: str = ros2.RELIABLE) -> Publisher:
        """Publishes messages of a type on a topic of the node's namespace, or on one that begins with a slash."""
        token, key = self.announce("MP", topic, kind, quality)
        return Publisher(self, kind, key, token)

    def subscriber(self, topic: str, kind: str, quality: str = ros2.RELIABLE, depth: int = 16) -> Subscriber:
        """Subscribes to such a topic; the newest `depth` samples wait."""
        token, key = self.announce("MS", topic, kind, quality)
        return Subscriber(self, kind, key, token, depth)

    def announce(self, role: Role, topic: str, kind: str, quality: str) -> tuple[str, str]:
        it = self.participant
        full = ros2.absolute(self.namespace, topic)
        key = ros2.topic_key(it.style, full, kind, domain=it.domain, types=it.types)
        if it.style == "ros2dds":
            return ros2.dds_token(it.zid, role, full, kind), key
        rest = ros2.endpoint_topic(full, kind, quality, it.types)
        entity = next(it.numbers)
        return ros2.endpoint_token(it.domain, it.zid, self._number, entity, role, self.namespace, self.name, rest), key

    def close(self) -> None:
        if self._token is not None:
            self._token.undeclare()


class _Endpoint:
    """Announcement of one end of a topic by a node."""

    def __init__(self, node: Node, kind: str, key: str, token: str) -> None:
        participant = node.participant
        self._node = node  # a token without a reference is taken back: the node lives as long as what it has
        self.kind: Final = kind
        self.key: Final = key
        self._types = participant.types
        self._token = pubsub.alive_token(participant.session, token) if participant.announces else None

    def close(self) -> None:
        if self._token is not None:
            self._token.undeclare()


class Publisher(_Endpoint):
    """Publisher of a topic."""

    def __init__(self, node: Node, kind: str, key: str, token: str) -> None:
        participant = node.participant
        self._gid = ros2.gid(token) if participant.style == "rmw" else None
        self._sequence = 0
        self._publisher = participant.session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_HIGH
        )
        super().__init__(node, kind, key, token)

    def put(self, message: Message) -> None:
        self.send(self._types.encode(message, self.kind))

    def send(self, payload: bytes) -> None:
        """Publishes a message that is CDR already."""
        if self._gid is None:
            self._publisher.put(payload)
            return
        self._sequence += 1
        now = round(self._node.participant.clock.utc() * 1e9)
        self._publisher.put(payload, attachment=ros2.attachment(self._sequence, now, self._gid))

    def close(self) -> None:
        super().close()
        self._publisher.undeclare()


class Subscriber(_Endpoint):
    """Subscriber of a topic."""

    def __init__(self, node: Node, kind: str, key: str, token: str, depth: int) -> None:
        self.malformed = 0  # samples that were no message of the topic's type
        self._subscriber = pubsub.subscriber(node.participant.session, key, depth)
        super().__init__(node, kind, key, token)

    def received(self) -> Iterator[Message]:
        """The messages that wait, oldest first."""
        for sample in network.received(self._subscriber.handler):
            try:
                yield self._types.decode(sample.payload.to_bytes(), self.kind)
            except ros2.UnknownMessage:
                self.malformed += 1

    def newest(self) -> Message | None:
        return next(iter(deque(self.received(), maxlen=1)), None)

    def close(self) -> None:
        super().close()
        self._subscriber.undeclare()
