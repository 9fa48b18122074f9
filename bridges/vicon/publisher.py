"""Positions from a Vicon for robots with external positions: `python -m bridges.vicon.publisher HOST --map CF01=cf_1`.

Occluded, implausible and repeated poses are not published: a robot notices silence, but would fly by a wrong pose.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from agents.body.external_pose import External
from agents.clock import Clock, uptime
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, closing_cleanly, end
from agents.protocols import vicon_datastream
from agents.protocols.vicon_datastream import MalformedBlock, Segment, parse_server
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline
from bridges.vicon.client import Frame, Reader

FIRST_S: Final = 5.0  # deadline of the first answer of the server
ATTEMPT_S: Final = 2.0  # deadline of each attempt to connect
PAUSE_S: Final = 0.5  # pause between attempts
SILENCE_S: Final = 2.0  # time without a frame before the next connection
LOST_S: Final = 0.5  # time of an occlusion before it is reported; robots tolerate half a second as well
REPEATED_S: Final = 0.3  # time of a pose that is the same to the last bit after which it counts as not measured
POLL_S: Final = 0.2  # latency of noticing the end of the process
RATE_OFF: Final = 0.005  # largest error of the frame rate that the server says: a queue that grows faster shows [s/s]
QUEUE_S: Final = 0.1  # frames that wait for longer are reported
SKEW: Final = 1e-3  # tolerance of a rotation's orthonormality


def heading(rotation: Sequence[float]) -> float:
    """Yaw [rad] of a rotation matrix (9,), row by row; NaN for an invalid one, such as zeros."""
    a, b, c, d, e, f, g, h, i = rotation
    worst = max(
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(a * d + b * e + c * f),
        abs(b * f - c * e - g),  # the third row is the product of the others
        abs(c * d - a * f - h),
        abs(a * e - b * d - i),
    )
    return math.atan2(d, a) if worst < SKEW and math.isfinite(sum(rotation)) else math.nan


class FrameQueue:
    """Time for which frames wait in queues: arrival less what their numbers say, less the least of that so far.

    A queue that empties shows at once; what is constant does not show.
    """

    def __init__(self) -> None:
        self._number, self._period, self._arrived = 0, 0.0, 0.0
        self._least = math.inf

    def wait_s(self, frame: Frame, arrived: float) -> float:
        """Time for which a frame waited that arrived at `arrived` on any steady clock [s]; 0 where it is unknown."""
        if frame.number < self._number or frame.period_s != self._period:  # another stream
            self._least = math.inf
        crept, delay = RATE_OFF * (arrived - self._arrived), arrived - frame.number * frame.period_s
        self._number, self._period = frame.number, frame.period_s
        self._arrived = arrived
        self._least = min(self._least + crept, delay)
        return delay - self._least if frame.period_s > 0.0 else 0.0


class PoseFilter:
    """Keeps the plausible poses of the robots in each frame, and reports changes in visibility."""

    def __init__(self, subjects: Mapping[str, str], print_line: Callable[[str], None]) -> None:
        """`subjects`: subject name by robot; `print_line` prints a line for users."""
        self._subjects = dict(subjects)
        self._print_line = print_line
        count = len(self._subjects)
        self._last = [External() for _ in self._subjects]
        self._seen_at = [-math.inf] * count  # time of each robot's last pose [s]
        self._pose: list[Segment | None] = [None] * count  # last pose of each robot,
        self._new_at = [-math.inf] * count  # time since which it is the same [s]
        self._reported: list[str | None] = [None] * count
        self._not_z_up = False
        self._invalid = 0

    @property
    def refused(self) -> int:
        """Number of poses refused: no rotation, not finite, or a jump faster than any robot."""
        return self._invalid + sum(last.refused for last in self._last)

    def filter_poses(
        self, frame: Frame, arrived: float, waited: float = 0.0
    ) -> list[tuple[str, float, Segment, float]]:
        """Name, time of measurement [s], segment and yaw [rad] of each robot with a plausible pose.

        Args:
            arrived: Time of arrival on any steady clock [s]; the times of measurement are on the same clock.
            waited: Time for which the frame waited in queues [s].
        """
        measured = arrived - frame.latency_s - waited
        if frame.z_up is self._not_z_up:
            self._not_z_up = not frame.z_up
            self._print_line("the z axis points up" if frame.z_up else NOT_Z_UP)
        poses = []
        for row, (robot, subject) in enumerate(self._subjects.items()):
            segment = frame.poses.get(subject)
            if segment != self._pose[row]:
                self._pose[row], self._new_at[row] = segment, arrived
            frozen = segment is not None and arrived - self._new_at[row] >= REPEATED_S
            if segment is not None and frame.z_up and not frozen:
                yaw = heading(segment.rotation)
                if math.isnan(yaw) or not all(map(math.isfinite, segment.position)):
                    self._invalid += 1
                elif self._last[row].update(measured, segment.position, yaw):
                    self._seen_at[row] = arrived
                    poses.append((robot, measured, segment, yaw))
            self._report(row, robot, subject, frame, arrived, frozen=frozen)
        return poses

    def _report(self, row: int, robot: str, subject: str, frame: Frame, now: float, *, frozen: bool) -> None:
        if frozen:
            state = f"{robot}: the pose of '{subject}' repeats itself to the last bit: the motion capture is frozen"
        elif now - self._seen_at[row] < LOST_S:
            state = f"{robot} is seen as '{subject}'"
        elif subject not in frame.poses:
            others = ", ".join(sorted(frame.poses)) or "none"
            state = f"{robot}: no subject '{subject}' (there are: {others}); name another with --map {robot}=SUBJECT"
        else:
            state = f"{robot} is not seen: markers hidden, or subject '{subject}' is switched off"
        if self._reported[row] != state:
            self._reported[row] = state
            self._print_line(state)


NOT_Z_UP: Final = "no positions: the server's z axis does not point up; change this in its options"


class Bridge:
    """Publishes the stream of a DataStream server; reconnects after its restarts."""

    def __init__(
        self,
        host: str,
        port: int,
        pose_filter: PoseFilter,
        publish: Callable[[messages.Position], object],
        print_line: Callable[[str], None],
        *,
        connect: Callable[[str, int, float], Reader] = Reader,
        pause_s: float = PAUSE_S,
    ) -> None:
        self._host, self._port = host, port
        self._filter, self._publish, self._print_line = pose_filter, publish, print_line
        self._connect, self._pause_s = connect, pause_s
        self._clock = Clock()
        self._state = ""

    def run(self, over: Callable[[], bool]) -> bool:
        """Run until `over()`; False if the server did not answer in the first 5 s."""
        begun = time.monotonic()
        pause = threading.Event()
        ever = False
        while not over():
            left = FIRST_S - (time.monotonic() - begun)
            if not ever and left <= 0.0:
                return False
            try:
                reader = self._connect(self._host, self._port, ATTEMPT_S if ever else min(ATTEMPT_S, max(0.1, left)))
            except (OSError, MalformedBlock) as error:
                self._report_once(f"no connection to {self._host}:{self._port}: {describe_error(error)}; trying again")
                pause.wait(self._pause_s)
                continue
            ever = True
            self._report_once(f"connected to {self._host}:{self._port}")
            try:
                self._pump(reader, over)
            except (OSError, MalformedBlock) as error:
                self._report_once(f"lost {self._host}:{self._port}: {describe_error(error)}; trying again")
            finally:
                reader.close()
            pause.wait(self._pause_s)
        return True

    def _pump(self, reader: Reader, over: Callable[[], bool]) -> None:
        heard, number = uptime(), None
        queue = FrameQueue()
        while not over():
            frame = reader.newest(POLL_S)
            now = uptime()
            if frame is None or frame.number == number:
                if now - heard > SILENCE_S:
                    raise TimeoutError(f"no new frame for {SILENCE_S:g} s (is the system live, and not paused?)")
                continue
            heard, number = now, frame.number
            waited = queue.wait_s(frame, now)
            if waited > QUEUE_S:
                self._report_once("frames wait in a queue before they arrive: is the network or a computer too slow?")
            for robot, measured, segment, yaw in self._filter.filter_poses(frame, now, waited):
                self._publish(messages.position(robot, self._clock.at(measured), segment.position, yaw))

    def _report_once(self, state: str) -> None:
        if state != self._state:
            self._state = state
            self._print_line(state)


def describe_error(error: OSError | MalformedBlock) -> str:
    """Text of an error, without the operating system's numbers."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


class ViconLaunch(NetworkLaunch, frozen=True, kw_only=True, rename="kebab"):
    """Positions from a Vicon for robots."""

    server: Annotated[
        str, Meta(title="HOST[:PORT]", description=f"where Tracker or Nexus runs; port {vicon_datastream.PORT}")
    ]
    map: Annotated[
        list[str], Meta(title="ROBOT[=SUBJECT]", description="a robot, and its subject in the Vicon; may be repeated")
    ] = msgspec.field(default_factory=list)


def serve(launch: ViconLaunch) -> int:
    """Run the bridge until a signal, or until its lifeline is lost and the robots are gone; returns the exit code."""
    host, port = parse_server(launch.server)
    subjects = parse_maps(launch.map)
    stop, lost = threading.Event(), threading.Event()

    def print_line(line: str) -> None:
        print(f"vicon: {line}", file=sys.stderr, flush=True)

    if launch.lifeline:
        Lifeline(lost).start()
    identity = launch.identity or "positioning"
    with (
        on_termination(stop.set),
        closing_cleanly(network.open_session(launch.endpoints(), name="vicon", stop=stop, identity=identity)) as (
            session,
            declared,
        ),
    ):
        keys, robots = Keys(launch.realm), list(subjects)
        farewell = Farewell(session, keys, robots, lost)
        mime = messages.MIME["json"]
        publishers = {robot: pubsub.NumberedPublisher(session, keys.position(robot), mime) for robot in robots}

        def publish(position: messages.Position) -> None:
            publishers[position.robot].put(messages.encode(position))

        made = Bridge(host, port, PoseFilter(subjects, print_line), publish, print_line)
        declared += [farewell, made]
        if made.run(lambda: stop.is_set() or farewell.over()):
            return 0
    print_line(
        f"no answer from {host}:{port} in {FIRST_S:g} s. Is that the computer that runs Tracker or Nexus, is it on "
        f"this network (ping {host}), and does its firewall let TCP port {port} in?"
    )
    return 2


def parse_maps(maps: Sequence[str]) -> dict[str, str]:
    """Subject by robot, from texts "ROBOT=SUBJECT" or "ROBOT"; raises ValueError for others, none or repetitions."""
    if not maps:
        raise ValueError("name the robots with --map ROBOT or --map ROBOT=SUBJECT")
    found: dict[str, str] = {}
    for each in maps:
        robot, equals, subject = each.partition("=")
        if not robot or (equals and not subject):
            raise ValueError(f"'{each}' is neither ROBOT nor ROBOT=SUBJECT")
        subject = subject or robot
        if robot in found or subject in found.values():
            raise ValueError(f"'{each}' names a robot or a subject of another --map")
        found[robot] = subject
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    return command_line.run("zenpark bridge vicon", ViconLaunch, serve, arguments, (ValueError,))


if __name__ == "__main__":
    end(main())
