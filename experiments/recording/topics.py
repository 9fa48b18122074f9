"""Topics of a recording: each kind of message with its key on the network, its topic and its type in the file.

The recorder subscribes by this table, the writer and the playback look topics up in it. Further topics have types that
every viewer draws: `/<robot>/true_pose` (geometry_msgs/PoseStamped), `/tf` (tf2_msgs/TFMessage, from the frame `map` to
a frame of each robot's name) and `/scene` (visualization_msgs/MarkerArray: arena, obstacles, robots, links in the
colours of their errors).

Attached are the experiment as it was written (`experiment.toml`), this case with its overrides (`experiment.json`), and
the figures of its kinds of robots (`kinds.json`), for readers without them. The metadata record `zenpark` has case,
seed and clock, and the code, versions and machine that made it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgspec

from agents.network.keys import Keys
from agents.network.messages import (
    BareGoal,
    BarePose,
    CentreState,
    Contact,
    Event,
    Goal,
    HostClock,
    LawMemory,
    Pose,
    State,
    Status,
    Variable,
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


class SentPose(BarePose, frozen=True, kw_only=True):
    """A pose as it was sent to the neighbours, by a robot with a law without variables to transmit."""

    received: float  # [s] UTC, by the recorder
    size: int  # [bytes] length of the payload on the network


class SpokenPose(SentPose, frozen=True, kw_only=True):
    """A pose as it was sent to the neighbours, with what the law said."""

    shared: list[Variable]


class SentGoal(BareGoal, frozen=True, kw_only=True):
    """A goal as the central controller sent it, without its velocity."""

    received: float  # [s] UTC, by the recorder
    size: int  # [bytes] length of the payload on the network


@dataclass(frozen=True)
class Topic:
    """Topic of a kind of message."""

    message: type[Message]  # type on the network
    recorded: type[msgspec.Struct]  # type in the file, `zenpark_msgs/<its name>`
    name: str  # name in the file, with `{robot}` for the robot's name
    key: Callable[[Keys], str]
    depth: int = RARE  # samples that may wait for the recorder
    repeated: bool = False  # True if the publisher's cache repeats it for late subscribers
    finite: bool = False  # messages with numbers that are not finite are malformed


# of poses with what a law says; they come with the others, and older recordings have none
SPOKEN: Final = Topic(Pose, SpokenPose, "/{robot}/spoken_pose", lambda keys: keys.pose("*"), DEPTH, repeated=True)
TOPICS: Final = (
    Topic(State, State, "/{robot}/state", lambda keys: keys.state("*"), DEPTH),  # carries the poses received since
    Topic(Pose, SentPose, "/{robot}/pose", lambda keys: keys.pose("*"), DEPTH, repeated=True),
    SPOKEN,
    Topic(LawMemory, LawMemory, "/{robot}/memory", lambda keys: keys.memory("*"), DEPTH),
    Topic(Status, Status, "/{robot}/status", lambda keys: keys.status("*"), repeated=True),
    Topic(Event, Event, "/events", lambda keys: keys.event, repeated=True),
    Topic(Contact, Contact, "/world/contact", lambda keys: keys.contact, finite=True),
    Topic(WorldState, WorldState, "/world/state", lambda keys: keys.world, finite=True),
    Topic(Goal, SentGoal, "/{robot}/goal", lambda keys: keys.goal("*"), DEPTH, finite=True),
    Topic(CentreState, CentreState, "/centre/report", lambda keys: keys.centre, finite=True),
    Topic(HostClock, HostClock, "/run/clock", lambda keys: keys.clock, repeated=True, finite=True),
)
