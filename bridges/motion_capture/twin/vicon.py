"""Protocol twin of a Vicon: a DataStream server."""

from __future__ import annotations

from collections.abc import Sequence

from bridges.motion_capture.protocol import vicon_datastream
from bridges.motion_capture.protocol.vicon_datastream import BlockKind, Segment
from bridges.motion_capture.twin.capture import CaptureClient, SeenBody, StreamTwin


class ViconTwin(StreamTwin):
    """DataStream server. A body that is not tracked has no segments."""

    WELCOME = vicon_datastream.pack_kinds(vicon_datastream.POSES)
    framer = staticmethod(vicon_datastream.framer)

    def _answer(self, client: CaptureClient, kind: int, payload: bytes) -> None:
        for block, content in vicon_datastream.blocks(payload):
            if block == BlockKind.REQUEST_FRAME:
                client.streams = content[:1] == b"\x01"
                client.asked += not client.streams
            elif block == BlockKind.REQUEST_NEXT_FRAME:
                client.asked += 1

    def _packet(self, client: CaptureClient, frame: bytes) -> bytes:
        """The packet of a frame, with names and axes for a client that has none."""
        names = [vicon_datastream.pack_subject(number, name) for number, name in enumerate(self._names())]
        described = [vicon_datastream.pack_stream_info(self._rate), vicon_datastream.pack_axes(), *names]
        return vicon_datastream.packet(*([] if client.named else described), frame)

    def _encode(self, number: int, t: float, bodies: Sequence[SeenBody]) -> bytes:
        frame = vicon_datastream.pack_frame_number(number)
        frame += vicon_datastream.pack_latency([("Data Collected", self.latency_s)])
        order = {name: row for row, name in enumerate(self._names())}
        for body in bodies:
            x, y, z = body.position.tolist()
            segment = Segment(0, (x, y, z), tuple(body.rotation.reshape(9).tolist()))
            frame += vicon_datastream.pack_segments(order[body.name], [segment] if body.tracked else [])
        return frame
