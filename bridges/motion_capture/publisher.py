"""Positions from motion capture for robots: `python -m bridges.motion_capture.publisher vicon HOST --map CF01=cf_1`.

Occluded, implausible and repeated poses are not published: a robot notices silence, but would fly by a wrong pose.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from agents.body.byte_stream import MalformedStream
from agents.body.capture_reader import CaptureFrame, CaptureReader, MeasuredPose
from agents.body.coordinates import Coordinates
from agents.body.external_pose import External
from agents.clock import Clock, StampAge, uptime
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, closing_cleanly, end
from agents.plugins import registry
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline
from agents.vectors import NotNegative, Vector

FIRST_S: Final = 5.0  # deadline of the first answer of the server
ATTEMPT_S: Final = 2.0  # deadline of each attempt to connect
PAUSE_S: Final = 0.5  # pause between attempts
SILENCE_S: Final = 2.0  # time without a frame before the next connection
LOST_S: Final = 0.5  # time of an occlusion before it is reported; robots tolerate half a second as well
REPEATED_S: Final = 0.3  # time of a pose that is the same to the last bit after which it counts as not measured
POLL_S: Final = 0.2  # latency of noticing the end of the process
RATE_OFF: Final = 0.005  # largest error of the frame rate that the server says: a queue that grows faster shows [s/s]
QUEUE_S: Final = 0.1  # frames that wait for longer are reported
AGAIN_S: Final = 0.1  # time of lower frame numbers after which the system has begun to count again
SHOWN_S: Final = 1.0  # time over which rate and latency are measured before they are shown
LATE_S: Final = 0.1  # latency from which on drones sway [s]


class PoseFilter:
    """Keeps the plausible poses of the robots in each frame, and reports changes in visibility."""

    def __init__(
        self,
        subjects: Mapping[str, str],
        print_line: Callable[[str], None],
        coordinates: Coordinates = Coordinates(),  # noqa: B008 - frozen
        *,
        up: str = "z",
    ) -> None:
        """Keep the poses of some robots.

        Args:
            subjects: Name of the body by robot.
            print_line: Prints a line for users.
            coordinates: Where the arena lies; left out: in the origin of the system.
            up: Axis that points up where neither the stream nor `coordinates` says so.
        """
        self._subjects = dict(subjects)
        self._print_line, self._coordinates, self._up = print_line, coordinates, up
        count = len(self._subjects)
        self._last = [External() for _ in self._subjects]
        self._seen_at = [-math.inf] * count  # time of each robot's last pose [s]
        self._pose: list[MeasuredPose | None] = [None] * count  # last pose of each robot,
        self._new_at = [-math.inf] * count  # time since which it is the same [s]
        self._reported: list[str | None] = [None] * count
        self._refusal, self._axis = "", ""  # reason why the axes cannot be used; first axis that pointed up
        self._invalid = 0

    @property
    def refused(self) -> int:
        """Number of poses refused: no rotation, not finite, or a jump faster than any robot."""
        return self._invalid + sum(last.refused for last in self._last)

    def filter_poses(
        self, frame: CaptureFrame, arrived: float, waited: float = 0.0
    ) -> list[tuple[str, float, Vector, float]]:
        """Name, time of measurement [s], position [m] and yaw [rad] of each robot with a plausible pose.

        Args:
            arrived: Time of arrival on any steady clock [s]; the times of measurement are on the same clock.
            waited: Time since the measurement beside the latency that the frame says [s].
        """
        latency = frame.latency_s if frame.latency_s > 0.0 else 0.0  # also of NaN: nothing is measured in the future
        measured = arrived - latency - waited
        up = frame.up or self._coordinates.up or self._up
        self._check_axes(up)
        poses = []
        for row, (robot, subject) in enumerate(self._subjects.items()):
            pose = frame.poses.get(subject)
            if pose != self._pose[row]:
                self._pose[row], self._new_at[row] = pose, arrived
            frozen = pose is not None and arrived - self._new_at[row] >= REPEATED_S
            if pose is not None and not (self._refusal or frozen):
                position, yaw = self._coordinates.placed(*pose, up)
                if not math.isfinite(yaw + sum(position)):
                    self._invalid += 1
                elif self._last[row].update(measured, position, yaw):
                    self._seen_at[row] = arrived
                    poses.append((robot, measured, position, yaw))
            self._report(row, robot, subject, frame, arrived, frozen=frozen)
        return poses

    def _check_axes(self, up: str) -> None:
        """Say so, once, where the upward axis of the system cannot be used or is another than the file says."""
        asked = self._coordinates.up
        refusal = "" if up in ("y", "z") else NOT_UPRIGHT
        self._axis = self._axis or ("" if refusal else up)
        if not refusal and asked and asked != up:
            refusal = f"no positions: the system says that its {up} axis points up, not {asked} as `up` says"
        elif not refusal and up != self._axis:
            refusal = f"no positions: the {up} axis points up now, not {self._axis}: start this bridge again"
        if refusal != self._refusal:
            self._refusal = refusal
            self._print_line(refusal or f"the {up} axis points up")

    def _report(self, row: int, robot: str, subject: str, frame: CaptureFrame, now: float, *, frozen: bool) -> None:
        if frozen:
            state = f"{robot}: the pose of '{subject}' repeats itself to the last bit: the motion capture is frozen"
        elif now - self._seen_at[row] < LOST_S:
            state = f"{robot} is seen as '{subject}'"
        elif subject not in frame.poses:
            others = ", ".join(sorted(frame.poses)) or "none"
            state = f"{robot}: no body '{subject}' (there are: {others}); name another: --map {robot}=BODY, or `names`"
        else:
            state = f"{robot} is not seen: markers hidden, or body '{subject}' is switched off"
        if self._reported[row] != state:
            self._reported[row] = state
            self._print_line(state)


NOT_UPRIGHT: Final = (
    "no positions: neither the z axis nor the y axis of the system points up; change this in its options"
)


class Bridge:
    """Publishes the stream of a motion capture system; reconnects after its restarts."""

    def __init__(
        self,
        host: str,
        port: int,
        pose_filter: PoseFilter,
        publish: Callable[[messages.Position], object],
        print_line: Callable[[str], None],
        *,
        connect: Callable[[str, int, float], CaptureReader],
        latency_s: float = 0.0,
        pause_s: float = PAUSE_S,
    ) -> None:
        """Connect to `host` and `port` with `connect`; `latency_s` is added to the latency that frames say [s]."""
        self._host, self._port = host, port
        self._name = address(host, port)
        self._filter, self._publish, self._print_line = pose_filter, publish, print_line
        self._connect, self._latency, self._pause_s = connect, latency_s, pause_s
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
            except (OSError, MalformedStream) as error:
                self._report_once(f"no connection to {self._name}: {describe_error(error)}; trying again")
                pause.wait(self._pause_s)
                continue
            ever = True
            self._report_once(f"connected to {self._name}")
            try:
                self._pump(reader, over)
            except (OSError, MalformedStream) as error:
                self._report_once(f"lost {self._name}: {describe_error(error)}; trying again")
            finally:
                reader.close()
            pause.wait(self._pause_s)
        return True

    def _pump(self, reader: CaptureReader, over: Callable[[], bool]) -> None:
        heard, number = uptime(), -1
        ages, figures = StampAge(RATE_OFF), StreamFigures(self._print_line, self._latency)
        while not over():
            frame = reader.newest(POLL_S)
            now = uptime()
            if frame is not None and frame.number < number and now - heard > AGAIN_S:
                number, ages = -1, StampAge(RATE_OFF)  # the system was started again: its numbers, and its clock
            if frame is None or frame.number <= number:
                if now - heard > SILENCE_S:
                    raise TimeoutError(f"no new frame for {SILENCE_S:g} s (is the system live, and not paused?)")
                continue
            heard, number = now, frame.number
            waited = 0.0 if math.isnan(frame.clock_s) else ages.age(now, frame.clock_s)
            if waited > QUEUE_S:
                self._report_once("frames wait in a queue before they arrive: is the network or a computer too slow?")
            figures.count(frame, now)
            for robot, measured, position, yaw in self._filter.filter_poses(frame, now, waited + self._latency):
                self._publish(messages.position(robot, self._clock.at(measured), position, yaw))

    def _report_once(self, state: str) -> None:
        if state != self._state:
            self._state = state
            self._print_line(state)


class StreamFigures:
    """Rate and latency of a stream: printed once after a second, and again when the latency passes `LATE_S`."""

    def __init__(self, print_line: Callable[[str], None], latency_s: float) -> None:
        """`latency_s`: latency beside that which frames say [s]."""
        self._print_line, self._latency = print_line, latency_s
        self._begun = self._said_late = math.nan
        self._frames, self._sum = 0, 0.0

    def count(self, frame: CaptureFrame, now: float) -> None:
        """Count a frame that arrived at `now` [s]."""
        if math.isnan(self._begun):
            self._begun = now
            return
        self._frames, self._sum = self._frames + 1, self._sum + frame.latency_s
        if (since := now - self._begun) < SHOWN_S:
            return
        mean = self._sum / self._frames + self._latency
        late = mean > LATE_S
        if self._said_late != late:
            self._said_late = late
            rate = f"{self._frames / since:.0f} frames/s"
            age = f", {1e3 * mean:.1f} ms from the exposure to the sending"
            if math.isnan(mean):
                age = f"; the system does not say how old they are when it sends them (`latency_s`: {self._latency:g})"
            self._print_line(rate + age + (": too late for drones (limit 0.15 s, network included)" if late else ""))
        self._begun = now
        self._frames, self._sum = 0, 0.0


def address(host: str, port: int) -> str:
    """Host and port for messages; a file has no port."""
    return f"{host}:{port}" if port else host


def describe_error(error: OSError | MalformedStream) -> str:
    """Text of an error, without the operating system's numbers."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


class PositioningLaunch(NetworkLaunch, frozen=True, kw_only=True, rename="kebab"):
    """Positions from motion capture for robots."""

    system: Annotated[str, Meta(title="SYSTEM", description="vicon, optitrack, qualisys, vrpn, cameras, a plug-in's")]
    server: Annotated[
        str, Meta(title="HOST[:PORT]", description="where the program of the system runs; of cameras, their file")
    ]
    map: Annotated[
        list[str], Meta(title="ROBOT[=BODY]", description="a robot, and its body in the system; may be repeated")
    ] = msgspec.field(default_factory=list)
    up: Annotated[Literal["y", "z"] | None, Meta(title="AXIS", description="axis that points up: y or z")] = None
    unit: Annotated[
        Literal["m", "cm", "mm"], Meta(title="UNIT", description="m, cm or mm, if the protocol has none")
    ] = "m"
    origin: Annotated[
        str, Meta(title="X,Y,Z", description="centre of the arena's floor in the system's coordinates [m]")
    ] = "0,0,0"
    heading: Annotated[
        float, Meta(title="RAD", description="yaw of the arena's x axis in the system's coordinates")
    ] = 0.0
    latency_s: Annotated[
        NotNegative, Meta(title="SECONDS", description="latency that the system's stream does not say")
    ] = 0.0


def serve(launch: PositioningLaunch) -> int:
    """Run the bridge until a signal, or until its lifeline is lost and the robots are gone; returns the exit code."""
    system = registry.load(registry.POSITIONING, launch.system)
    host, port = system.parse(launch.server)
    subjects = parse_maps(launch.map)
    coordinates = Coordinates.parse(launch.up, launch.unit, launch.origin, launch.heading)
    stop, lost = threading.Event(), threading.Event()

    def print_line(line: str) -> None:
        print(f"{launch.system}: {line}", file=sys.stderr, flush=True)

    if launch.lifeline:
        Lifeline(lost).start()
    identity = launch.identity or "positioning"
    with (
        on_termination(stop.set),
        closing_cleanly(
            network.open_session(launch.endpoints(), name=launch.system, stop=stop, identity=identity)
        ) as opened,
    ):
        session, declared = opened
        keys, robots = Keys(launch.realm), list(subjects)
        farewell = Farewell(session, keys, robots, lost)
        mime = messages.MIME["json"]
        publishers = {robot: pubsub.NumberedPublisher(session, keys.position(robot), mime) for robot in robots}

        def publish(position: messages.Position) -> None:
            publishers[position.robot].put(messages.encode(position))

        pose_filter = PoseFilter(subjects, print_line, coordinates, up=system.UP)
        made = Bridge(host, port, pose_filter, publish, print_line, connect=system, latency_s=launch.latency_s)
        declared += [farewell, made]
        if made.run(lambda: stop.is_set() or farewell.over()):
            return 0
    hint = system.HINT.format(program=system.PROGRAM, host=host, transport=system.TRANSPORT, port=port)
    print_line(f"no answer from {address(host, port)} in {FIRST_S:g} s. {hint}")
    return 2


def parse_maps(maps: Sequence[str]) -> dict[str, str]:
    """Body by robot, from texts "ROBOT=BODY" or "ROBOT"; raises ValueError for others, none or repetitions."""
    if not maps:
        raise ValueError("name the robots with --map ROBOT or --map ROBOT=BODY")
    found: dict[str, str] = {}
    for each in maps:
        robot, equals, subject = each.partition("=")
        if not robot or (equals and not subject):
            raise ValueError(f"'{each}' is neither ROBOT nor ROBOT=BODY")
        subject = subject or robot
        if robot in found or subject in found.values():
            raise ValueError(f"'{each}' names a robot or a body of another --map")
        found[robot] = subject
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    return command_line.run("zenpark bridge", PositioningLaunch, serve, arguments, (ValueError,))


if __name__ == "__main__":
    end(main)
