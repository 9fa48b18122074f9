"""CaptureReader of the Vicon DataStream in plain Python: one socket, no threads, no vendor library.

The vendor's own client blocks the interpreter while it connects, and never returns once its server has died.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import ClassVar

from agents.body.byte_stream import MalformedStream, Packet
from agents.body.capture_reader import CaptureFrame, MeasuredPose, PacketReader, by_name
from bridges.motion_capture.protocol import vicon_datastream
from bridges.motion_capture.protocol.vicon_datastream import BlockKind, Segment, Subject


class Decoder:
    """Decodes packets to frames; keeps subject names and axes, which are not in every packet."""

    def __init__(self) -> None:
        self._subjects: dict[int, Subject] = {}
        self._up, self._period = "z", 0.0

    def frame(self, body: bytes) -> CaptureFrame | None:
        """Decode a packet; None if it has only names, axes or answers; raises MalformedStream if it is damaged."""
        number, latency = None, math.nan
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
                self._up = "z" if payload[:1] == bytes([vicon_datastream.Z_UP]) else "other"
        if named:
            self._subjects = named  # the server resends all when one changes
        if number is None:
            return None
        poses = by_name(
            [
                (
                    known.name,
                    next((MeasuredPose(*s[1:]) for s in seen.get(known.number, ()) if s.number == known.root), None),
                )
                for known in self._subjects.values()
            ]
        )
        clock = number * self._period if self._period > 0.0 else math.nan
        return CaptureFrame(number, poses, latency if latency >= 0.0 else math.nan, self._up, clock)


class ViconReader(PacketReader):
    """Connection to a DataStream server, that of Tracker or Nexus."""

    PORT: ClassVar = vicon_datastream.PORT
    METRES: ClassVar = True
    PROGRAM: ClassVar = "Tracker or Nexus"
    TWIN: ClassVar = "bridges.motion_capture.twin.vicon:ViconTwin"

    def __init__(self, host: str, port: int = vicon_datastream.PORT, timeout_s: float = 2.0) -> None:
        self._decoder = Decoder()
        super().__init__(host, port, timeout_s, vicon_datastream.framer())

    def _subscribe(self, deadline: float) -> None:
        offered = self._offered_streams(deadline)
        if BlockKind.GLOBAL_SEGMENTS not in offered:
            raise MalformedStream("the server has no segments to offer")
        wanted = offered.intersection(vicon_datastream.POSES)
        stream = vicon_datastream.packet(vicon_datastream.block(BlockKind.REQUEST_FRAME, b"\x01"))
        self._socket.sendall(vicon_datastream.pack_kinds(wanted) + stream)

    def _decoded(self, packets: Iterable[Packet]) -> CaptureFrame | None:
        frames = [frame for _, body in packets if (frame := self._decoder.frame(body)) is not None]
        return max(frames, key=lambda frame: frame.number, default=None)

    def _offered_streams(self, deadline: float) -> set[int]:
        while True:
            for kind, payload in vicon_datastream.blocks(self._next_packet(deadline)[1]):
                if kind == BlockKind.OBJECT_ENUMS:
                    return vicon_datastream.unpack_kinds(payload)
