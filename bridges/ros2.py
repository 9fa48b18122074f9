"""ROS 2 bridge over rmw_zenoh: the robots of a realm as ROS 2 topics, without ROS here: `python -m bridges.ros2`.

Published: /<robot>/pose, /<robot>/velocity and /diagnostics. Subscribed: /<robot>/goal. A robot's topics exist while
its liveliness token does.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import isfinite, isnan, nan
from typing import Annotated, Final

import msgspec
import zenoh
from msgspec import Meta

from agents.decision.lifecycle import Phase
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import end, held
from agents.protocols import ros2
from agents.protocols.ros2 import Distro, Message, Types
from agents.protocols.ros2_node import Participant, Publisher, Subscriber
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline

NODE: Final = "zenpark"
FRAME: Final = "map"  # the arena, as rviz and nav2 name the fixed frame; goals must be in it
POLL_S: Final = 0.01
REACH: Final = (1e3, 1e3, 1e3)  # [m] bounds of valid positions: any room
OK, WARN, ERROR = 0, 1, 2  # levels of a DiagnosticStatus


class GoalHeight:
    """Height of a robot's goals: RViz and nav2 send them in the plane, where z = 0 means "keep your height"."""

    def __init__(self) -> None:
        # of the last goal that has one; before, where the robot began to run [m]; NaN: not known yet
        self._kept = nan

    @property
    def known(self) -> bool:
        """Whether a state with a position was received."""
        return not isnan(self._kept)

    def follow(self, phase: str, height: float) -> None:
        """Note the measured height [m] of the robot in this phase."""
        if phase != Phase.RUNNING.word or not self.known:
            self._kept = height

    def of_goal(self, z: float) -> float:
        """The height [m] meant by the z [m] of a goal."""
        self._kept = z or self._kept
        return self._kept


@dataclass
class _Robot:
    """Topics of one robot, and its goal's publisher in the realm."""

    pose: Publisher
    velocity: Publisher
    goal: Subscriber
    goal_publisher: zenoh.Publisher
    stamp: float = 0.0  # of the last pose published to ROS, UTC [s]
    height: GoalHeight = field(default_factory=GoalHeight)

    def close(self) -> None:
        self.pose.close()
        self.velocity.close()
        self.goal.close()
        self.goal_publisher.undeclare()  # type: ignore[no-untyped-call]


class Graph:
    """The robots of a realm as ROS 2 topics; call `poll` from a loop."""

    def __init__(self, session: zenoh.Session, participant: Participant, keys: Keys) -> None:
        # goals that are not finite, not in the frame "map", for a robot without a published pose, or received while a
        # central controller is alive
        self.refused = 0
        self._session, self._keys = session, keys
        self._types = participant.types
        self._node = participant.node(NODE)
        self._diagnostics = self._node.publisher("/diagnostics", ros2.DIAGNOSTIC_ARRAY)
        self._robots: dict[str, _Robot] = {}
        self._states = pubsub.Inbox(pubsub.subscriber(session, keys.state("*"), 1024), messages.State, keys=keys)
        self._statuses = pubsub.Inbox(pubsub.pose_subscriber(session, keys.status("*"), 256), messages.Status)
        self._alive = pubsub.AliveWatch(session, keys.alive("*"))
        self._centres = pubsub.AliveWatch(session, keys.centre_alive)
        self._centralised = False
        self._clock = participant.clock
        self._seq = round(self._clock.utc() * 1e3)  # above the sequence numbers of any earlier sender of goals

    @property
    def malformed(self) -> int:
        """Samples of the realm that were refused."""
        return self._states.malformed + self._statuses.malformed

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that are alive, sorted."""
        return tuple(sorted(self._robots))

    def poll(self) -> None:
        """Forward all received samples and messages."""
        statuses = [*self._update_robots(), *self._diagnostics_of_statuses()]
        if statuses:
            header = self._types.header(self._clock.utc(), "")
            self._diagnostics.put(self._types.make(ros2.DIAGNOSTIC_ARRAY, header=header, status=statuses))
        self._publish_states()
        for _, alive in self._centres.changes():
            self._centralised = alive
        for name, robot in self._robots.items():
            for message in robot.goal.received():
                self._forward_goal(name, robot, message)

    def _update_robots(self) -> list[Message]:
        """Add and remove robots by their liveliness tokens; returns the diagnostics of the removed ones."""
        gone = []
        for token, there in self._alive.changes():
            name = self._keys.whose(token)
            if name is None:
                continue
            if not there:
                if (robot := self._robots.pop(name, None)) is not None:
                    robot.close()
                    gone.append(diagnostic(self._types, name, ERROR, "gone", {}))
            elif name not in self._robots:
                self._robots[name] = self._declare_topics(name)
        return gone

    def _declare_topics(self, name: str) -> _Robot:
        chunk = ros_name(name)
        return _Robot(
            self._node.publisher(f"/{chunk}/pose", ros2.POSE_STAMPED),
            self._node.publisher(f"/{chunk}/velocity", ros2.TWIST_STAMPED),
            self._node.subscriber(f"/{chunk}/goal", ros2.POSE_STAMPED, depth=8),
            pubsub.publisher(self._session, self._keys.goal(name), messages.JSON),
        )

    def _publish_states(self) -> None:
        """Publish received states as pose and velocity."""
        now = self._clock.utc()
        for state in self._states.read(lambda state: validation.check_state(state, now=now, reach=REACH)):
            if (robot := self._robots.get(state.robot)) is None:
                continue
            robot.stamp = state.stamp
            if state.position is not None:
                robot.height.follow(state.phase, state.position[2])
                robot.pose.put(pose(self._types, state, state.position))
            if state.velocity is not None:
                robot.velocity.put(velocity(self._types, state, state.velocity))

    def _diagnostics_of_statuses(self) -> list[Message]:
        return [diagnosis(self._types, status) for status in self._statuses.read() if status.robot in self._robots]

    def _forward_goal(self, name: str, robot: _Robot, message: Message) -> None:
        """Forward a goal from ROS into the realm, unless a central controller sends goals."""
        place, q = message.pose.position, message.pose.orientation
        numbers = (place.x, place.y, place.z, q.x, q.y, q.z, q.w)
        known = robot.height.known and robot.stamp > 0.0 and message.header.frame_id in ("", FRAME)
        if self._centralised or not known or not all(isfinite(number) for number in numbers):
            self.refused += 1
            return
        turned = q.x or q.y or q.z or q.w  # a quaternion of zeros means any yaw
        yaw = ros2.yaw_of(q) if turned else None
        self._seq += 1
        position = place.x, place.y, robot.height.of_goal(place.z)
        goal = messages.Goal(name, self._seq, self._clock.utc(), position, yaw, robot.stamp)
        robot.goal_publisher.put(messages.encode(goal))


def ros_name(robot: str) -> str:
    """A robot's name as a ROS name: letters, digits, underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", robot)
    return f"_{name}" if name[:1].isdigit() else name


def pose(types: Types, state: messages.State, position: messages.Vector) -> Message:
    """A PoseStamped in the arena; only the robot's yaw is known, and an unknown yaw is sent as 0."""
    header = types.header(state.stamp, FRAME)
    return types.make(ros2.POSE_STAMPED, header=header, pose=types.pose(*position, state.yaw or 0.0))


def velocity(types: Types, state: messages.State, linear: messages.Vector) -> Message:
    """A TwistStamped along the axes of the arena; the angular part is unknown and zero."""
    twist = types.twist(linear, (0.0, 0.0, 0.0))
    return types.make(ros2.TWIST_STAMPED, header=types.header(state.stamp, FRAME), twist=twist)


def diagnosis(types: Types, status: messages.Status) -> Message:
    """A DiagnosticStatus: a warning while the robot, its body or the network reports a fault."""
    level = WARN if status.body or status.missing or status.hazard else OK
    text = "; ".join(part for part in (status.phase, status.reason, status.hazard, status.body) if part)
    values = {
        "phase": status.phase,
        "reason": status.reason,
        "hazard": status.hazard,
        "body": status.body,
        "battery": "" if status.battery is None else f"{status.battery:.3f}",
        "missing": " ".join(status.missing),
        "sent": str(status.sent),
        "heard": str(status.received),
        "lost": str(sum(status.lost.values())),
        "malformed": str(status.malformed),
        "refused": str(status.refused),
        "interventions": str(status.interventions),
        "missed ticks": f"{status.missed} of {status.ticks}",
    }
    return diagnostic(types, status.robot, level, text, values)


def diagnostic(types: Types, robot: str, level: int, text: str, values: dict[str, str]) -> Message:
    pairs = [types.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    return types.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=f"{NODE}: {robot}",
        message=text,
        hardware_id=robot,
        values=pairs,
    )


class Ros2Launch(NetworkLaunch, frozen=True, kw_only=True, rename="kebab"):
    """The robots as ROS 2 topics."""

    ros: Annotated[list[str], Meta(title="ENDPOINT", description="router of ROS 2 (rmw_zenohd), if another")] = (
        msgspec.field(default_factory=list)
    )
    domain: Annotated[int, Meta(ge=0, le=ros2.MAX_DOMAIN, description="ROS_DOMAIN_ID")] = 0
    distro: Annotated[Distro, Meta(description="ROS 2 distribution, for type hashes")] = "jazzy"


def serve(launch: Ros2Launch) -> int:
    """Run the bridge until a signal or the loss of its lifeline; prints when ready and when a robot comes or goes."""
    stop = threading.Event()
    if launch.lifeline:
        Lifeline(stop).start()
    types = ros2.types(launch.distro)
    with on_termination(stop.set), ExitStack() as stack:
        identity = launch.identity or "ros2"
        opened = held(network.open_session(launch.endpoints(), name="ros2", stop=stop, identity=identity))
        session, declared = stack.enter_context(opened)
        outside = session
        if launch.ros:
            outside, _ = stack.enter_context(held(network.open_session(launch.ros, name="ros2", stop=stop)))
        graph = Graph(session, Participant(outside, types, style="rmw", domain=launch.domain), Keys(launch.realm))
        declared.append(graph)
        print(f"ros2 ready: node /{NODE}, domain {launch.domain}, {launch.distro}", flush=True)
        known: tuple[str, ...] = ()
        while not stop.wait(POLL_S):
            graph.poll()
            if graph.robots != known:
                known = graph.robots
                print(f"ros2: robots {' '.join(known) or 'none'}", flush=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    return command_line.run("zenpark bridge ros2", Ros2Launch, serve, arguments)


if __name__ == "__main__":
    end(main())
