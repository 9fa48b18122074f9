"""Client of the Vicon DataStream in plain Python: one socket, no threads, no vendor library.

The vendor's own client blocks the interpreter while it connects, and never returns once its server has died.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

from agents.protocols import vicon_datastream
from agents.protocols.vicon_datastream import BlockKind, Framer, MalformedBlock, Segment, Subject

CHUNK: Final = 1 << 18  # [bytes] read at once: about ten frames of twenty bodies


@dataclass(frozen=True)
class Frame:
    """One frame of motion capture."""

    number: int  # number of the server
    latency_s: float  # age when sent
    poses: dict[str, Segment | None]  # root segment of each subject; None while occluded
    z_up: bool
    period_s: float = 0.0  # time from one frame to the next; 0: the server has not said it


class Decoder:
    """Decodes packets to frames; keeps subject names and axes, which are not in every packet."""

    def __init__(self) -> None:
        self._subjects: dict[int, Subject] = {}
        self._z_up, self._period = True, 0.0

    def frame(self, body: bytes) -> Frame | None:
        """Decode a packet; None if it has only names, axes or answers; raises Malformed if it is damaged."""
        number, latency = None, 0.0
        named: dict[int, Subject] = {}
        seen: dict[int, list[Segment]] = {}
        for kind, payload in vicon_datastream.blocks(body):
            if kind == BlockKind.GLOBAL_SEGMENTS:
                subject, segments = vicon_datastream.unpack_segments(payload)
                seen[subject] = segments
            elif kind == BlockKind.FRAME_INFO:
                number = vicon_datastream.unpack_frame_number(payload)
            elif kind == BlockKind.LATENCY_INFO:
                latency = vicon_datastream.unpack_latency(payload)
            elif kind == BlockKind.STREAM_INFO:
                self._period = vicon_datastream.unpack_period(payload)
            elif kind == BlockKind.SUBJECT_INFO:
                known = vicon_datastream.unpack_subject(payload)
                named[known.number] = known
            elif kind == BlockKind.APPLICATION_INFO:
                self._z_up = payload[:1] == bytes([vicon_datastream.Z_UP])
        if named:
            self._subjects = named  # the server resends all when one changes
        if number is None:
            return None
        poses = {
            known.name: next((s for s in seen.get(known.number, ()) if s.number == known.root), None)
            for known in self._subjects.values()
        }
        return Frame(number, latency if latency > 0.0 else 0.0, poses, self._z_up, self._period)


class Reader:
    """Connection to a DataStream server, which streams every frame."""

    def __init__(self, host: str, port: int = vicon_datastream.PORT, timeout_s: float = 2.0) -> None:
        """Connect and request the stream; raises OSError without an answer in time, Malformed for one without poses."""
        deadline = time.monotonic() + timeout_s
        self._framer, self._decoder = Framer(), Decoder()
        self._waiting: deque[bytes] = deque()  # packets received, not decoded yet
        self._socket = socket.create_connection((host, port), timeout_s)
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            offered = self._offered_streams(deadline)
            if BlockKind.GLOBAL_SEGMENTS not in offered:
                raise MalformedBlock("the server has no segments to offer")
            wanted = offered.intersection(vicon_datastream.POSES)
            stream = vicon_datastream.packet(vicon_datastream.block(BlockKind.REQUEST_FRAME, b"\x01"))
            self._socket.sendall(vicon_datastream.pack_kinds(wanted) + stream)
        except (OSError, MalformedBlock):
            self._socket.close()
            raise

    def newest(self, timeout_s: float) -> Frame | None:
        """Newest frame received, or None at the timeout.

        Older frames are dropped: their time of arrival is unknown.

        Raises:
            OSError: If the connection is lost.
            Malformed: If the stream is damaged.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            self._drain()
            bodies, self._waiting = self._waiting, deque()
            frames = [frame for body in bodies if (frame := self._decoder.frame(body)) is not None]
            if frames:
                return frames[-1]
            if not self._readable(deadline):
                return None

    def close(self) -> None:
        self._socket.close()

    def _offered_streams(self, deadline: float) -> set[int]:
        while True:
            if not self._readable(deadline):
                raise TimeoutError("no answer")
            self._drain()
            while self._waiting:
                for kind, payload in vicon_datastream.blocks(self._waiting.popleft()):
                    if kind == BlockKind.OBJECT_ENUMS:
                        return vicon_datastream.unpack_kinds(payload)

    def _readable(self, deadline: float) -> bool:
        waiting = select.poll()
        waiting.register(self._socket, select.POLLIN)
        return bool(waiting.poll(1000.0 * max(0.0, deadline - time.monotonic())))

    def _drain(self) -> None:
        """Read all packets that have arrived."""
        while True:
            try:
                received = self._socket.recv(CHUNK)
            except BlockingIOError:
                return
            if not received:
                raise ConnectionResetError("the server has closed the connection")
            self._waiting += self._framer.feed(received)
