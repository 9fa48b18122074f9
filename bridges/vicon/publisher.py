"""Positions from a Vicon for robots that get theirs from outside: `python -m bridges.vicon.publisher HOST --map
CF01=cf_1`.

What motion capture did not see, or saw somewhere else than any robot can be, is not published: a robot notices silence,
but would fly by a wrong pose.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import zenoh

from agents.body.external_pose import External
from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import Farewell
from agents.protocols import vicon_datastream
from agents.protocols.vicon_datastream import Malformed, Segment
from agents.runtime.command_line import add_network, reached, told_to_end
from agents.runtime.lifeline import Lifeline
from bridges.vicon.client import Frame, Reader

FIRST_S: Final = 5.0  # who has not answered by then is not there
ATTEMPT_S: Final = 2.0  # deadline of each attempt to connect
PAUSE_S: Final = 0.5  # between attempts
SILENCE_S: Final = 2.0  # without a frame the connection is made anew
LOST_S: Final = 0.5  # not seen for so long is worth a line; half a second is also what robots bear
LOOK_S: Final = 0.2  # how soon the end of the process is noticed
SKEW: Final = 1e-3  # how far from orthonormal a rotation may be


def heading(rotation: Sequence[float]) -> float:
    """Yaw [rad] of a rotation to the room (9,), row by row; NaN if it is no rotation, as zeros are none."""
    a, b, c, d, e, f, g, h, i = rotation  # plain numbers: numpy takes ten times as long for three rows
    worst = max(
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(a * d + b * e + c * f),
        abs(b * f - c * e - g),  # the third row is the product of the others
        abs(c * d - a * f - h),
        abs(a * e - b * d - i),
    )
    return math.atan2(d, a) if worst < SKEW and math.isfinite(sum(rotation)) else math.nan


class Sieve:
    """Lets through what a frame says of robots, if it can be true."""

    def __init__(self, subjects: Mapping[str, str], say: Callable[[str], None]) -> None:
        """`subjects` are those of the robots, by robot; `say` takes a line for people."""
        self._subjects = dict(subjects)
        self._say = say
        self._last = External(len(self._subjects))
        self._since = np.full(len(self._subjects), -np.inf)  # when each was seen last
        self._told: list[str | None] = [None] * len(self._subjects)
        self._turned = False
        self._broken = 0

    @property
    def refused(self) -> int:
        """Poses that were no pose, or jumps farther than any robot moves."""
        return self._broken + self._last.refused

    def sift(self, frame: Frame, arrived: float) -> list[tuple[str, float, Segment, float]]:
        """Of each robot that was seen: its name, when [s], where, and its yaw [rad].

        Args:
            frame: What motion capture says.
            arrived: When it arrived, on any steady clock [s]; "when" is on the same clock.
        """
        measured = arrived - frame.latency_s
        if frame.z_up is self._turned:
            self._turned = not frame.z_up
            self._say("the z axis points up" if frame.z_up else TURNED)
        believed = []
        for row, (robot, subject) in enumerate(self._subjects.items()):
            segment = frame.poses.get(subject)
            if segment is not None and frame.z_up:
                yaw = heading(segment.rotation)
                position = np.array(segment.position)
                if math.isnan(yaw) or not all(map(math.isfinite, segment.position)):
                    self._broken += 1
                elif self._last.update(row, measured, position, yaw):
                    self._since[row] = arrived
                    believed.append((robot, measured, segment, yaw))
            self._report(row, robot, subject, frame, arrived)
        return believed

    def _report(self, row: int, robot: str, subject: str, frame: Frame, now: float) -> None:
        if now - self._since[row] < LOST_S:
            state = f"{robot} is seen as '{subject}'"
        elif subject not in frame.poses:
            others = ", ".join(sorted(frame.poses)) or "none"
            state = f"{robot}: no subject '{subject}' (there are: {others}); name another with --map {robot}=SUBJECT"
        else:
            state = f"{robot} is not seen: markers hidden, or subject '{subject}' is switched off"
        if self._told[row] != state:
            self._told[row] = state
            self._say(state)


TURNED: Final = "no positions: the server's z axis does not point up; set it so in its options"


class Positions:
    """Publishes the poses of robots, each on its key `position`."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str]) -> None:
        mime = messages.MIME["json"]
        self._publishers = {robot: pubsub.publisher(session, keys.position(robot), mime) for robot in robots}

    def publish(self, robot: str, stamp: float, segment: Segment, yaw: float) -> None:
        """Says where a robot was at UTC time `stamp` [s]."""
        self._publishers[robot].put(messages.encode(messages.position(robot, stamp, segment.position, yaw)))


class Bridge:
    """Reads a DataStream server for ever, over any number of its restarts."""

    def __init__(self, host: str, port: int, sieve: Sieve, positions: Positions, say: Callable[[str], None]) -> None:
        self._host, self._port = host, port
        self._sieve, self._positions, self._say = sieve, positions, say
        self._clock = Clock()
        self._state = ""

    def run(self, over: Callable[[], bool]) -> bool:
        """Bridges until it is over; False if nobody answered in the first seconds."""
        begun = time.monotonic()
        pause = threading.Event()
        ever = False
        while not over():
            left = FIRST_S - (time.monotonic() - begun)
            if not ever and left <= 0.0:
                return False
            try:
                reader = Reader(self._host, self._port, ATTEMPT_S if ever else min(ATTEMPT_S, max(0.1, left)))
            except (OSError, Malformed) as error:
                self._tell(f"no connection to {self._host}:{self._port}: {reason(error)}; trying again")
                pause.wait(PAUSE_S)
                continue
            ever = True
            self._tell(f"connected to {self._host}:{self._port}")
            try:
                self._pump(reader, over)
            except (OSError, Malformed) as error:
                self._tell(f"lost {self._host}:{self._port}: {reason(error)}; trying again")
            finally:
                reader.close()
            pause.wait(PAUSE_S)
        return True

    def _pump(self, reader: Reader, over: Callable[[], bool]) -> None:
        heard = time.monotonic()
        while not over():
            frame = reader.newest(LOOK_S)
            now = time.monotonic()
            if frame is None:
                if now - heard > SILENCE_S:
                    raise TimeoutError(f"no frame for {SILENCE_S:g} s (is the system live, and not paused?)")
                continue
            heard = now
            for robot, measured, segment, yaw in self._sieve.sift(frame, now):
                self._positions.publish(robot, self._clock.at(measured), segment, yaw)

    def _tell(self, state: str) -> None:
        if state != self._state:
            self._state = state
            self._say(state)


def reason(error: OSError | Malformed) -> str:
    """What went wrong, without numbers of the operating system."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def bridge(
    server: str,
    subjects: Mapping[str, str],
    endpoints: Sequence[str],
    *,
    realm: str = "park",
    lifeline: bool = False,
    identity: str = "positioning",
) -> int:
    """Bridges until SIGINT, SIGTERM or the loss of its lifeline (and of the robots); returns the exit code.

    Args:
        server: "HOST" or "HOST:PORT" of the DataStream server.
        subjects: The subject that each robot is, by robot.
        endpoints: Routers.
        realm: First chunk of the keys.
        lifeline: Whether standard input is a lifeline.
        identity: Whose certificate is shown, in a lab.

    Raises:
        network.Unreachable: If no router answers.
        EndpointError: If an endpoint is malformed.
    """
    host, port = split(server)
    stop, lost = threading.Event(), threading.Event()

    def say(line: str) -> None:
        print(f"vicon: {line}", file=sys.stderr, flush=True)

    if lifeline:
        Lifeline(lost).start()
    with (
        told_to_end(stop.set),
        network.open_session(endpoints, name="vicon", stop=stop, identity=identity) as session,
    ):
        keys, robots = Keys(realm), list(subjects)
        farewell = Farewell(session, keys, robots, lost)
        made = Bridge(host, port, Sieve(subjects, say), Positions(session, keys, robots), say)
        if made.run(lambda: stop.is_set() or farewell.over()):
            return 0
    say(
        f"nobody answered at {host}:{port} in {FIRST_S:g} s. Is that the computer that runs Tracker or Nexus, is it on "
        f"this network (ping {host}), and does its firewall let TCP port {port} in?"
    )
    return 2


def split(server: str) -> tuple[str, int]:
    """Host and port of "HOST" or "HOST:PORT".

    Raises:
        ValueError: If it is neither.
    """
    host, colon, port = server.partition(":")
    if not host or (colon and not (port.isascii() and port.isdigit() and 0 < int(port) < 65536)):
        raise ValueError(f"'{server}' is neither HOST nor HOST:PORT, such as 192.168.0.10:801")
    return host, int(port) if colon else vicon_datastream.PORT


def pairs(maps: Sequence[str]) -> dict[str, str]:
    """Subjects by robot, of "ROBOT=SUBJECT" or "ROBOT", whose subject has its name.

    Raises:
        ValueError: If one is neither, or a robot or subject comes twice.
    """
    found: dict[str, str] = {}
    for each in maps:
        robot, equals, subject = each.partition("=")
        if not robot or (equals and not subject):
            raise ValueError(f"'{each}' is neither ROBOT nor ROBOT=SUBJECT")
        subject = subject or robot
        if robot in found or subject in found.values():
            raise ValueError(f"'{each}' names a robot or a subject that another --map has named")
        found[robot] = subject
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    parser = argparse.ArgumentParser(prog="zenpark bridge vicon", description="Positions from a Vicon for robots.")
    parser.add_argument(
        "server", metavar="HOST[:PORT]", help=f"where Tracker or Nexus runs; port {vicon_datastream.PORT}"
    )
    parser.add_argument(
        "--map", action="append", required=True, metavar="ROBOT[=SUBJECT]", help="a robot, and what the Vicon calls it"
    )
    add_network(parser, "positioning")
    chosen = parser.parse_args(arguments)
    try:
        return bridge(
            chosen.server,
            pairs(chosen.map),
            reached(chosen),
            realm=chosen.realm,
            lifeline=chosen.lifeline,
            identity=chosen.identity,
        )
    except (ValueError, network.Unreachable) as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
