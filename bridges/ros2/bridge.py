"""The robots of a realm as ROS 2 topics over rmw_zenoh, without ROS here: `python -m bridges.ros2.bridge`.

Published: /<robot>/pose, /<robot>/velocity, /<robot>/scan, /tf, /scene and /diagnostics. Subscribed: /<robot>/goal. A
robot's topics exist while its liveliness token does; its scan from its first range readings on.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, isfinite, isnan, nan, radians, remainder, tau
from typing import Annotated, Final

import msgspec
import numpy as np
import zenoh
from msgspec import Meta

from agents.decision.lifecycle import Phase
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import closing_cleanly, end
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Distro, Message, Types
from bridges.ros2.node import Participant, Publisher, Subscriber

NODE: Final = "zenpark"
FRAME: Final = "map"  # the arena, as rviz and nav2 name the fixed frame; goals must be in it
POLL_S: Final = 0.01
DEGREE: Final = radians(1.0)
SAME: Final = 1e-3  # [rad] bearings that differ less are one
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
class _RobotTopics:
    """Topics of one robot, and its goal's publisher in the realm."""

    pose: Publisher
    velocity: Publisher
    goal: Subscriber
    goal_publisher: zenoh.Publisher
    frame: str
    scan: Publisher | None = None  # None until the first range readings
    stamp: float = 0.0  # stamp of the last pose published to ROS, UTC [s]
    height: GoalHeight = field(default_factory=GoalHeight)

    def close(self) -> None:
        self.pose.close()
        self.velocity.close()
        if self.scan is not None:
            self.scan.close()
        self.goal.close()
        self.goal_publisher.undeclare()


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
        self._transforms = self._node.publisher("/tf", ros2.TF_MESSAGE, ros2.TRANSFORMS)
        self._markers = self._node.publisher("/scene", ros2.MARKER_ARRAY)
        self._scenes = pubsub.subscriber(session, keys.scene, 4)
        self._robots: dict[str, _RobotTopics] = {}
        self._feed = pubsub.RobotFeed(session, keys)
        self._ranges = pubsub.Inbox(pubsub.subscriber(session, keys.ranges("*"), 256), messages.Ranges, keys=keys)
        self._centres = pubsub.AliveWatch(session, keys.centre_alive)
        self._centralised = False
        self._clock = participant.clock
        self._seq = round(self._clock.utc() * 1e3)  # greater than the sequence numbers of any earlier sender of goals

    @property
    def malformed(self) -> int:
        """Samples of the realm that were refused."""
        return self._feed.malformed + self._ranges.malformed

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
        self._publish_scans()
        for sample in network.received(self._scenes.handler):
            self._markers.send(sample.payload.to_bytes())
        for _, alive in self._centres.changes():
            self._centralised = alive
        for name, robot in self._robots.items():
            for message in robot.goal.received():
                self._forward_goal(name, robot, message)

    def _update_robots(self) -> list[Message]:
        """Add and remove robots by their liveliness tokens; returns the diagnostics of the removed ones."""
        gone = []
        for name, stands in self._feed.alive():
            if not stands:
                if (robot := self._robots.pop(name, None)) is not None:
                    robot.close()
                    gone.append(diagnostic(self._types, name, ERROR, "gone", {}))
            elif name not in self._robots:
                self._robots[name] = self._declare_topics(name)
        return gone

    def _declare_topics(self, name: str) -> _RobotTopics:
        chunk = ros_name(name)
        return _RobotTopics(
            self._node.publisher(f"/{chunk}/pose", ros2.POSE_STAMPED),
            self._node.publisher(f"/{chunk}/velocity", ros2.TWIST_STAMPED),
            self._node.subscriber(f"/{chunk}/goal", ros2.POSE_STAMPED, depth=8),
            pubsub.publisher(self._session, self._keys.goal(name), messages.JSON),
            chunk,
        )

    def _publish_states(self) -> None:
        """Publish received states as pose, transform and velocity."""
        now, transforms = self._clock.utc(), []
        for state in self._feed.states.read(
            lambda state: validation.check_state(state, now=now, valid_box=validation.ANY_ROOM)
        ):
            if (robot := self._robots.get(state.robot)) is None:
                continue
            robot.stamp = state.stamp
            if state.position is not None:
                robot.height.follow(state.phase, state.position[2])
                robot.pose.put(pose(self._types, state, state.position))
                transforms.append(transform(self._types, state, state.position, robot.frame))
            if state.velocity is not None:
                robot.velocity.put(velocity(self._types, state, state.velocity))
        if transforms:
            self._transforms.put(self._types.make(ros2.TF_MESSAGE, transforms=transforms))

    def _publish_scans(self) -> None:
        """Publish received range readings; a robot's topic is declared with its first ones."""
        now = self._clock.utc()
        for ranges in self._ranges.read(lambda ranges: validation.check_ranges(ranges, now=now)):
            robot = self._robots.get(ranges.robot)
            made = None if robot is None else scan(self._types, ranges, robot.frame)
            if robot is None or made is None:
                continue
            if robot.scan is None:
                robot.scan = self._node.publisher(f"/{robot.frame}/scan", ros2.LASER_SCAN)
            robot.scan.put(made)

    def _diagnostics_of_statuses(self) -> list[Message]:
        return [diagnosis(self._types, status) for status in self._feed.statuses.read() if status.robot in self._robots]

    def _forward_goal(self, name: str, robot: _RobotTopics, message: Message) -> None:
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


def transform(types: Types, state: messages.State, position: messages.Vector, frame: str) -> Message:
    """A TransformStamped from the arena to the robot's frame: its place and yaw, as in its pose."""
    return types.make(
        ros2.TRANSFORM_STAMPED,
        header=types.header(state.stamp, FRAME),
        child_frame_id=frame,
        transform=types.transform(*position, state.yaw or 0.0),
    )


def scan(types: Types, ranges: messages.Ranges, frame: str) -> Message | None:
    """A LaserScan of the horizontal rays; None without any.

    A LaserScan has equal steps: a place without a ray is NaN, a ray with nothing in reach is infinite (REP 117). The
    reach of the sensor is not known here: `range_max` is that of any.
    """
    found = zip(ranges.bearing, ranges.elevation, ranges.distance, strict=True)
    flat = [(remainder(bearing, tau), distance) for bearing, up, distance in found if abs(up) < DEGREE]
    if not flat:
        return None
    start, step, places = steps([bearing for bearing, _ in flat])
    values = [nan] * (max(places) + 1)
    for place, (_, distance) in zip(places, flat, strict=True):
        hit = inf if distance is None else distance
        if not values[place] <= hit:  # the nearer of two hits at one place counts
            values[place] = hit
    return types.make(
        ros2.LASER_SCAN,
        header=types.header(ranges.stamp, frame),
        angle_min=start,
        angle_max=start + step * (len(values) - 1),
        angle_increment=step,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=validation.MAX_RANGE,
        ranges=np.array(values, np.float32),
        intensities=np.zeros(0, np.float32),
    )


def steps(bearings: Sequence[float]) -> tuple[float, float, list[int]]:
    """The first angle [rad] and the step [rad] of a scan with these bearings [rad], and the place of each in it.

    Where the bearings are no multiples of the smallest gap between two, the step is one degree.
    """
    start = min(bearings)
    along = [bearing - start for bearing in bearings]
    span, step = max(along), DEGREE
    gaps = [after - before for before, after in pairwise(sorted(along))]
    gap = min((each for each in gaps if each > SAME), default=inf)
    if tau / validation.MAX_RAYS - SAME < gap < inf:
        equal = span / round(span / gap)
        if max(abs(each - equal * round(each / equal)) for each in along) < SAME:
            step = equal
    return start, step, [round(each / step) for each in along]


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
        "received": str(status.received),
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
        opened = closing_cleanly(network.open_session(launch.endpoints(), name="ros2", stop=stop, identity=identity))
        session, declared = stack.enter_context(opened)
        outside = session
        if launch.ros:
            outside, _ = stack.enter_context(closing_cleanly(network.open_session(launch.ros, name="ros2", stop=stop)))
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
    end(main)
