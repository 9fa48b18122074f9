"""Topics of a recording: each kind of message with its key on the network and its topic in the file.

The recorder subscribes by this table, the writer and the playback look topics up in it. Each message of the file is a
ROS 2 message of one field, `data`, with the payload as it went over the network. That is JSON text, or bytes of
MessagePack in the types `...Packed`. The schema has the JSON Schema of the payload as a comment. Poses and goals were
logged when the recorder got them, other messages at their stamps.

Further topics have types that every viewer draws: `/<robot>/true_pose` (geometry_msgs/PoseStamped), `/tf`
(tf2_msgs/TFMessage, from the frame `map` to a frame of each robot's name) and `/scene` (visualization_msgs/MarkerArray:
arena, obstacles, robots, links in the colours of their errors).

Attached are the experiment as it was written (`experiment.toml`), this case with its overrides (`experiment.json`), and
the figures of its kinds of robots (`kinds.json`), for readers without them. The metadata record `zenpark` has case,
seed and clock, and the code, versions and machine that made it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from agents.network.keys import Keys
from agents.network.messages import (
    CentreState,
    Contact,
    Event,
    Goal,
    HostClock,
    LawMemory,
    Pose,
    State,
    Status,
    WorldState,
)

TOML: Final = "experiment.toml"
JSON: Final = "experiment.json"
KINDS_JSON: Final = "kinds.json"
METADATA: Final = "zenpark"
CHUNK_BYTES: Final = 32 * 1024  # lost at most by a kill: a third of a second of seven robots
DEPTH: Final = 20_000  # samples that may wait while the disk does
RARE: Final = 1_000  # depth of those at 1 Hz or rarer: a ring takes its memory as it first goes round

Message = Pose | LawMemory | State | Status | Event | Contact | WorldState | Goal | CentreState | HostClock


class SentPose(Pose, frozen=True):
    """A pose as it was sent to the neighbours."""

    received: float = 0.0  # [s] UTC, by the recorder
    size: int = 0  # [bytes] length of the payload on the network


class SentGoal(Goal, frozen=True):
    """A goal as the central controller sent it."""

    received: float = 0.0  # [s] UTC, by the recorder
    size: int = 0  # [bytes] length of the payload on the network


@dataclass(frozen=True)
class Topic:
    """Topic of a kind of message."""

    message: type[Message]
    name: str  # name in the file, with `{robot}` for the robot's name
    key: Callable[[Keys], str]
    depth: int = RARE  # samples that may wait for the recorder
    repeated: bool = False  # True if the publisher's cache repeats it for late subscribers
    finite: bool = False  # messages with numbers that are not finite are malformed
    packed: bool = False  # payloads have the encoding of the experiment; the others are JSON


TOPICS: Final = (
    # a state carries the poses received since the one before
    Topic(State, "/{robot}/state", lambda keys: keys.state("*"), DEPTH, packed=True),
    Topic(Pose, "/{robot}/pose", lambda keys: keys.pose("*"), DEPTH, repeated=True, packed=True),
    Topic(LawMemory, "/{robot}/memory", lambda keys: keys.memory("*"), DEPTH, packed=True),
    Topic(Status, "/{robot}/status", lambda keys: keys.status("*"), repeated=True, packed=True),
    Topic(Event, "/events", lambda keys: keys.event, repeated=True),
    Topic(Contact, "/world/contact", lambda keys: keys.contact, finite=True),
    Topic(WorldState, "/world/state", lambda keys: keys.world, finite=True),
    Topic(Goal, "/{robot}/goal", lambda keys: keys.goal("*"), DEPTH, finite=True, packed=True),
    Topic(CentreState, "/centre/report", lambda keys: keys.centre, finite=True),
    Topic(HostClock, "/run/clock", lambda keys: keys.clock, repeated=True, finite=True),
)
