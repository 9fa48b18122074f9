"""Drivers of a Khepera IV on one connection: K-Team's protocol, and the park servers, by what each of them obeys."""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Final

from agents.clock import uptime
from bridges.khepera4 import protocol
from bridges.khepera4.odometry import Odometer

NEVER: Final = math.inf
REPORTED_S: Final = (0.004, 0.045)  # a report of way that covers less or more is not used to complete another
GAP_S: Final = 0.3  # [s] commands further apart were parted by a gap of the link
FIRST_ANSWER_S: Final = 3.0  # [s] patience for the first answer: a late one spends the only client of a server of 2023
GLUED_S: Final = 0.15  # [s] time without an answer to `p` after which it is sent again
ASK_AGAIN_S: Final = 1.4  # [s] pause before another `p`: a server does not see the one that is glued to a stop
MAX_INPUT_BYTES: Final = 1 << 16  # [bytes] longest input: no robot sends as much
PLACED_S: Final = 1.0  # [s] pause between two positions that are given to a server which does not tell its own

Ranges = tuple[Sequence[float], Sequence[float]]  # bearings [rad], distances from the robot's centre [m]


class UnknownAnswer(OSError):
    """The answer does not belong to this protocol, or to the server that was named."""


class WrongServer(UnknownAnswer):
    """The server is none that is known, not known which, or not the one that was named: it must not be driven."""


class Wire:
    """Byte stream to and from a robot: a TCP connection or a serial line."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self._descriptor, self._close = descriptor, close
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)

    def send(self, data: bytes) -> None:
        """Write at once."""
        os.write(self._descriptor, data)

    def pending(self) -> bytes:
        """Input that has come so far; raises ConnectionError if the other end has closed, UnknownAnswer for a flood."""
        data = b""
        while self._poll.poll(0):
            data = _limited(data + self._read())
        return data

    def receive(self, until: float) -> bytes:
        """Next bytes; raises TimeoutError after `until` [s, `uptime`], ConnectionError if the other end has closed."""
        if not self._poll.poll(max(0.0, 1e3 * (until - uptime()))):
            raise TimeoutError
        return self._read()

    def close(self) -> None:
        """Close it; what was written is still delivered, which TCP does only if all input was read before."""
        try:
            self.pending()
        except OSError:
            pass
        finally:
            self._close()

    def _read(self) -> bytes:
        data = os.read(self._descriptor, 1024)
        if not data:
            raise ConnectionResetError("the robot closed the connection")
        return data


class Driver(ABC):
    """Protocol of a server. Every method raises OSError if the robot does not answer, or not in this protocol."""

    def __init__(self, wire: Wire, chosen: protocol.Khepera4Settings, *, ranged: bool) -> None:
        """`ranged`: it reads ranges."""
        self._wire, self.ranged = wire, ranged
        self.patience_s = chosen.silence_s  # [s] time without an answer after which a request fails

    @abstractmethod
    def begin(self) -> None:
        """Stop the robot of a new connection, then make sure which server runs on it."""

    @abstractmethod
    def drive(self, v: float, turn: float, until: float = NEVER) -> None:
        """Drive at v [m/s], ω [rad/s]; zeros stop the robot, as does whatever is sent after `until` [s, `uptime`]."""

    @abstractmethod
    def move(self, odometer: Odometer) -> None:
        """Request odometry and update `odometer`; the answer shows that the last command was read."""

    @abstractmethod
    def ranges(self) -> Ranges:
        """Bearings [rad] and distances from the robot's centre [m]."""

    def battery(self) -> float:
        """Charge, 0 to 1; NaN if the protocol has no such value."""
        return math.nan


class RoboticParkServer(Driver):
    """A server of Robotic Park that obeys `d`; what else it does is in `protocol.PARK`."""

    def __init__(self, wire: Wire, chosen: protocol.Khepera4Settings, server: protocol.ParkServer) -> None:
        super().__init__(wire, chosen, ranged=bool(chosen.ranges))
        self.server = server
        self._number = re.compile(rf"[-+]?\d+\.\d{{{server.decimals}}}")
        self._count = 3 if server.answer == "pose" else 2
        self._angle = server.base / protocol.BASE  # true angle per angle that the server counts
        self._free = -math.inf  # [s] earliest time of the next command
        self._sent = (math.nan, math.nan)  # [s] times of the last two commands, the later one last
        self._asked = self._counted = math.nan  # [s] time of the last p; end of the way that is counted
        self._speed = (0.0, 0.0)  # [m/s, rad/s] speeds by the last good report

    def begin(self) -> None:
        """See `Driver`. `identify` has made sure of the server."""
        self.drive(0.0, 0.0)

    def drive(self, v: float, turn: float, until: float = NEVER) -> None:
        self._send(protocol.park_drive(v, turn) if v or turn else b"stop", b"stop", until)

    def move(self, odometer: Odometer) -> None:
        self._add(self._reports(self._wire.pending()), odometer)  # late answers, after a gap
        before, asked = self._sent, self._asked
        answer = self._ask()
        reports = self._reports(answer)
        if not reports:
            raise UnknownAnswer(f"answers p with {_shown(answer)}, not with {self._count} numbers as before")
        if self.server.answer == "increments":
            self._add(reports, odometer)
        else:
            self._add_last(reports[-1], odometer, before, asked)

    def ranges(self) -> Ranges:
        self._send(b"get_data")
        try:
            answer = self._receive("get_data")
        except TimeoutError:
            self.ranged = False  # one that comes late would be read as odometry
            raise
        sound = protocol.numbers(answer.decode("ascii", "replace").strip("\0\r\n "))
        if len(sound) != len(protocol.SOUND_BEARING):
            raise UnknownAnswer(f"answers get_data with {_shown(answer)}; leave ranges out of its device table")
        return protocol.SOUND_BEARING, [protocol.sound_distance(each) for each in sound]

    def _send(self, command: bytes, instead: bytes = b"", until: float = NEVER) -> float:
        """Send a command in a segment of its own, or `instead` if it is past `until`; returns when [s]."""
        time.sleep(max(0.0, self._free - uptime()))  # pause: the second of two commands in one segment is lost
        self._wire.send(command if uptime() <= until else instead)
        now = uptime()
        self._free = now + protocol.GAP_S
        self._sent = self._sent[1], now
        return now

    def _ask(self) -> bytes:
        """The answer to `p`, which is asked twice: the network may glue the first to the command before it."""
        deadline = uptime() + self.patience_s
        self._asked = self._send(b"p")
        with contextlib.suppress(TimeoutError):
            return self._wire.receive(min(deadline, uptime() + GLUED_S))
        self._asked = self._send(b"p")
        return self._receive("p", deadline)

    def _receive(self, asked: str, deadline: float = NEVER) -> bytes:
        try:
            return self._wire.receive(min(deadline, uptime() + self.patience_s))
        except TimeoutError as error:
            raise TimeoutError(f"no answer to {asked}") from error

    def _reports(self, received: bytes) -> list[list[float]]:
        """Answers to `p`, which come without a mark between them."""
        numbers = [float(word) for word in self._number.findall(received.decode("ascii", "replace"))]
        whole = len(numbers) - len(numbers) % self._count
        return [numbers[at : at + self._count] for at in range(0, whole, self._count)]

    def _add(self, reports: list[list[float]], odometer: Odometer) -> None:
        """Add increments, each of which is reported once."""
        for way, turn in reports if self.server.answer == "increments" else ():
            odometer.steps(way, self._angle * turn, uptime())

    def _add_last(self, report: list[float], odometer: Odometer, sent: tuple[float, float], _asked: float) -> None:
        """Add the newest report of any other kind; two commands were `sent` before its request [s]."""
        if self.server.answer == "pose":
            x, y, theta = report
            odometer.pose(x, y, self._angle * theta, uptime())
        else:
            self._add_turn(report, odometer, sent)

    def _add_turn(self, report: list[float], odometer: Odometer, sent: tuple[float, float]) -> float:
        """Add the way of one turn of the server's loop [m], and its heading [rad]; returns the way with what lacks.

        The turn lasts from one command to the next, and only `p` reports it: the way between the last two commands of a
        period is lost. All is counted at the speed of this report, or across a gap at that of the last.
        """
        way, theta = report
        begin, end = sent
        since = end - self._counted
        if since <= GAP_S and REPORTED_S[0] <= end - begin <= REPORTED_S[1]:
            self._speed = way / (end - begin), 0.0
        way = self._speed[0] * since if since > 0.0 else 0.0
        self._counted = end
        odometer.heading(way, self._angle * theta, uptime())
        return way


class GoalPark(RoboticParkServer):
    """A server of Robotic Park that obeys only goals: its own controller is led by a goal just ahead of the robot.

    The driver sets the server's position to the origin, and lays the goal where the law of the server gives the wanted
    speeds (`protocol.park_goal_2023_04`, `protocol.park_goal_2023_01`). `stop` does not help: the next turn of its loop
    drives again.
    """

    def __init__(self, wire: Wire, chosen: protocol.Khepera4Settings, server: protocol.ParkServer) -> None:
        super().__init__(wire, chosen, server)
        self._theta = 0.0  # [rad] heading by the server's count
        self._placed = -math.inf  # [s] time at which the server's position was set
        self._way = 0.0, 0.0  # [m] way since then, in its frame
        self._about = 0.0  # [rad/s] rate of a turn toward a goal behind
        self._goal = (0.0, 0.0)  # [m] the last one, of a server that counts poses
        self._ahead = 0.0  # [m] distance to the farthest goal since the last count, behind which it has not driven

    def begin(self) -> None:
        """See `Driver`. The heading must be known before a goal is sent."""
        if not self.server.posed:
            self._send(b"p")
            reports = self._reports(self._receive("p"))
            if not reports:
                raise UnknownAnswer("answers p differently from one time to the next")
            self._theta = reports[-1][1]
        self.drive(0.0, 0.0)

    def drive(self, v: float, turn: float, until: float = NEVER) -> None:
        if self.server.posed:
            if v < 0.0:  # it drives ahead only: it turns about until the goal is before it
                self._about = self._about or -math.copysign(1.0, turn)
                v, turn = 0.0, self._about
            else:
                self._about = 0.0
            self._send(b"i 0.0 0.0 1.570796")
            goal, stay = protocol.park_goal_2023_04(v, turn), (0.0, 0.0)
            self._goal = goal
            self._ahead = max(self._ahead, math.hypot(*goal))
        else:
            now = uptime()
            if not (v or turn) or now - self._placed > PLACED_S:
                self._send(b"i 0.0 0.0")
                self._way, self._placed = (0.0, 0.0), now
            here = self._way
            goal, stay = (
                (here[0] + x, here[1] + y)
                for x, y in (
                    protocol.park_goal_2023_01(v, turn, self._theta),
                    protocol.park_goal_2023_01(0.0, 0.0, self._theta),
                )
            )
        self._send(protocol.park_goal(*goal), protocol.park_goal(*stay), until)

    def _add_last(self, report: list[float], odometer: Odometer, sent: tuple[float, float], asked: float) -> None:
        if not self.server.posed:
            way = self._add_turn(report, odometer, sent)
            self._theta = report[1]
            x, y = self._way
            self._way = x + way * math.cos(self._theta), y + way * math.sin(self._theta)
            return
        # the pose counts from the p before the last `i`, since a turn of the loop ends behind each command
        _, way, theta = report
        end = sent[1]
        since, reported = end - self._counted, end - asked
        turn = self._angle * math.remainder(theta - 0.5 * math.pi, 2.0 * math.pi)
        if since <= GAP_S and reported >= REPORTED_S[0]:
            self._speed = way / reported, turn / reported
        self._counted = end
        if since > 0.0:
            way, turned = self._speed[0] * since, self._speed[1] * since
            share = min(1.0, self._ahead / abs(way)) if since > GAP_S and way else 1.0
            odometer.steps(share * way, share * turned, uptime())
        self._ahead = math.hypot(*self._goal)


def identify(
    wire: Wire,
    chosen: protocol.Khepera4Settings,
    server: str | None,
    first_answer_s: float = FIRST_ANSWER_S,
    over: Callable[[], bool] = lambda: False,
) -> RoboticParkServer:
    """Stop a park robot, and find out or make sure by the answer to `p` which `server` runs on it, until it is `over`.

    Raises:
        WrongServer: If the answer is that of no server, of several, or not that of `server`.
        TimeoutError: If none comes.
        OSError: If the connection is lost.
    """
    wire.send(b"stop")
    time.sleep(protocol.GAP_S)
    answer, deadline = b"", uptime() + max(first_answer_s, chosen.silence_s)
    while not answer:
        if uptime() >= deadline or over():
            raise TimeoutError(
                "no answer to p; a server of 2023 serves one client in its life: restart it on the robot, for each case"
            )
        wire.send(b"p")
        with contextlib.suppress(TimeoutError):
            answer = wire.receive(min(deadline, uptime() + ASK_AGAIN_S))
    time.sleep(protocol.GAP_S)
    fitting = protocol.fitting(answer.decode("ascii", "replace").strip("\0\r\n "))
    if not fitting:
        raise WrongServer(f"answers p with {_shown(answer)}, as no known server does")
    if server is not None and server not in fitting:
        raise WrongServer(
            f"answers p with {_shown(answer)}, as the server of {' or '.join(fitting)} does, not that of {server}: "
            'set device = { server = "..." }'
        )
    if server is None and len(fitting) > 1:
        raise WrongServer(
            f"answers p with {_shown(answer)}, as the servers {', '.join(fitting)} do: write the one that runs there, "
            f'such as device = {{ server = "{fitting[0]}" }}, and restart it, for it may serve one client only'
        )
    kind = protocol.PARK[server or fitting[0]]
    return (RoboticParkServer if kind.drives else GoalPark)(wire, chosen, kind)


def _limited(data: bytes) -> bytes:
    """Input, unless it is too long."""
    if len(data) > MAX_INPUT_BYTES:
        raise UnknownAnswer("sends without end; is this a Khepera?")
    return data


def _shown(answer: bytes) -> str:
    return repr(answer[:40].decode("ascii", "replace"))


class KTeam(Driver):
    """K-Team's `kh4server`."""

    def __init__(self, wire: Wire, chosen: protocol.Khepera4Settings) -> None:
        super().__init__(wire, chosen, ranged=chosen.ranges is not False)

    def begin(self) -> None:
        self.drive(0.0, 0.0)
        self._request("B")
        if self.ranged:
            self._request("U,31")

    def drive(self, v: float, turn: float, until: float = NEVER) -> None:
        left, right = protocol.units(v, turn) if uptime() <= until else (0, 0)
        self._request(f"D,{left},{right}")

    def move(self, odometer: Odometer) -> None:
        left, right = self._request("R", 2)[:2]
        odometer.wheels(left, right, uptime())

    def ranges(self) -> Ranges:
        sound, light = len(protocol.SOUND_BEARING), len(protocol.LIGHT_BEARING)
        distances = [protocol.sound_distance(each) for each in self._request("G", sound)[:sound]]
        distances += [protocol.light_distance(each) for each in self._request("N", light)[:light]]
        return protocol.SOUND_BEARING + protocol.LIGHT_BEARING, distances

    def battery(self) -> float:
        return 0.01 * self._request("V,5", 1)[0]

    def _request(self, request: str, count: int = 0) -> list[float]:
        """Send a request; returns the numbers of the answer, at least `count`."""
        self._wire.pending()  # cannot be the answer
        self._wire.send(f"{request}\r".encode())
        until = uptime() + self.patience_s
        answer = b""
        while not answer.endswith(b"\n"):
            try:
                answer = _limited(answer + self._wire.receive(until))
            except TimeoutError as error:
                raise TimeoutError(f"no answer to {request}") from error
        letter, _, rest = answer.decode("ascii", "replace").strip().rpartition("\n")[2].partition(",")
        values = protocol.numbers(rest)
        if letter != request[0].lower() or len(values) < count:
            raise WrongServer(f"answers {request} with {answer[:40]!r}; is it K-Team's kh4server?")
        return values
