"""Bytes from and to Khepera IV robots and a Vicon."""

from collections import deque
from contextlib import ExitStack, closing
from itertools import count

import numpy as np

from agents.protocols import khepera4, vicon_datastream
from agents.protocols.vicon_datastream import BlockKind, Segment
from bridges.khepera4.drivers import KTeam, RoboticParkServer, identify
from bridges.khepera4.odometry import Odometer
from bridges.vicon.client import Decoder
from bridges.vicon.publisher import PoseFilter
from tests.fuzz.target import Place, Target, Wire, renewed
from tests.requests import request
from twins.devices.device import DeviceRequest, Faults
from twins.devices.khepera4 import KheperaDevice
from twins.devices.vicon import ViconTwin, _Client

LETTERS = dict(zip("pqrstk", (*khepera4.PARK, "kteam"), strict=True))  # the first byte says which server


def khepera_orders():
    park = ["d 10.0 0.5", "stop", "p", "t", "get_data", "g 1.0 0.5", "i 0.1 0.2 0.3", "d -81.0 -7"]
    kteam = ["B", "D,100,-100", "R", "G", "N", "O", "V,5", "U,31", "I", "E", "S", "T", "M,1,2", "K", "H", "J"]
    examples = [letter.encode() + word.encode() for word in park for letter in "pqrst"]
    return examples + [f"k{word}\rR\r".encode() for word in kteam]


@renewed(200, khepera_orders)
def khepera_twin():
    with ExitStack() as stack:
        devices = {}
        for letter, server in LETTERS.items():
            made = DeviceRequest(request("khepera4", "khepera4-twin", device={"server": server}), Faults())
            devices[letter] = stack.enter_context(closing(KheperaDevice(made)))
        for k in count():
            data = yield
            device = devices.get(data[:1].decode("ascii", "replace"), devices["p"])
            wire, server = Wire(), device.servers[0]
            server.client = wire
            wire.waiting += [data[1:256], data[256:512]] if len(data) > 256 else [data[1:]]
            while wire.waiting:
                device.serve(wire, 0.02 * k)
            for t in (0.02 * k + 0.01, 0.02 * k + 0.02):
                device.advance(t)
            assert np.isfinite(device.truth()[0]).all()
            if server.client is None:  # it has left, and some servers wait for no other
                return


class Line:
    def __init__(self, parts):
        self.parts = deque(parts)

    def send(self, data):
        assert data

    def pending(self):
        return b""

    def receive(self, _until):
        if not self.parts:
            raise TimeoutError
        return self.parts.popleft()[:1024]


def khepera_bridge():
    """Answers of all servers to everything that the link asks, apart by zero bytes."""

    whole, posed = [b"0.10,0.20,0.30"] * 3 + [b"1000,1000,50,1000,1000"], [b"0.1000,0.2000,0.3000"] * 3
    kteam = b"b,C,4 u d r,100,-100 g,1000,1000,50,1000,2000 n,40,40,40,40,40,40,40,900,1,1,1,1 v,80".split()
    answers = [(b"n", whole), (b"n", posed), (b"n", [whole[0][:7]]), (b"k", [word + b"\r\n" for word in kteam])]
    answers += [(letter, [b"0.1000,0.2000"] * 3) for letter in (b"p", b"q", b"t")]
    examples = [letter + b"\0".join([b"", *parts]) for letter, parts in answers]
    named = {b"p": "2023-01-07", b"q": "2023-01-15", b"t": "fork"}

    def take(data):
        which, *parts = data.split(b"\0")
        line = Line(parts)
        odometer = Odometer(0.0, 0.0, 0.0)
        driver: RoboticParkServer | KTeam
        if which[:1] == b"k":
            driver = KTeam(line, khepera4.Khepera4Settings())
        else:
            gap, khepera4.GAP_S = khepera4.GAP_S, 0.0  # without the pauses
            try:
                driver = identify(line, khepera4.Khepera4Settings(), named.get(which[:1]))
                driver.begin()
                driver.drive(0.1, 0.2)
                driver.move(odometer)
                driver.drive(-0.1, 0.2)
            finally:
                khepera4.GAP_S = gap
        if isinstance(driver, KTeam):
            driver.begin()
            driver.drive(0.1, 0.2)
        driver.move(odometer)
        assert np.isfinite((odometer.x, odometer.y, odometer.yaw)).all()
        _, distance = driver.ranges()
        assert not np.isinf(distance).any()
        driver.battery()

    yield Target(examples, take, (OSError,))


def _vicon_stream():
    names = b"".join([vicon_datastream.pack_stream_info(100.0), vicon_datastream.pack_axes(), *(
        vicon_datastream.pack_subject(k, name) for k, name in enumerate(("cf1", "kh1")))])  # fmt: skip
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    latency = vicon_datastream.pack_latency([("a", 0.002), ("b", 0.001)])
    frames = []
    for number in range(3):
        parts = [vicon_datastream.pack_segments(k, [Segment(0, (0.1 * number, 0.2, 0.3), eye)]) for k in range(2)]
        frames.append(vicon_datastream.pack_frame_number(number) + latency + b"".join(parts))
    return [
        vicon_datastream.packet(names, frames[0]),
        vicon_datastream.packet(names, frames[0]) + vicon_datastream.packet(frames[1]),
        vicon_datastream.packet(frames[1]), vicon_datastream.packet(names), vicon_datastream.packet(names,
        vicon_datastream.pack_axes(1), frames[2]),
        vicon_datastream.pack_kinds(vicon_datastream.POSES),
    ]  # fmt: skip


@renewed(300, _vicon_stream, (vicon_datastream.MalformedBlock,))
def vicon_bridge():
    """Output of a DataStream server, in chunks."""
    decoder, pose_filter = Decoder(), PoseFilter({"CF01": "cf1", "KH01": "kh1"}, lambda _: None)
    for k in count(1):
        data = yield
        framer = vicon_datastream.Framer()  # the connection is made anew after every error
        for begin in range(0, len(data), 4000):
            for body in framer.feed(data[begin : begin + 4000]):
                for kind, payload in vicon_datastream.blocks(body):
                    if kind == BlockKind.OBJECT_ENUMS:
                        vicon_datastream.unpack_kinds(payload)
                frame = decoder.frame(body)
                if frame is not None:
                    for _, measured, segment, yaw in pose_filter.filter_poses(frame, 0.01 * k):
                        assert np.isfinite((measured, yaw, *segment.position)).all()


def vicon_twin():
    """Requests of a client to the server."""
    ask = vicon_datastream.packet(vicon_datastream.block(BlockKind.REQUEST_FRAME, b"\1"))
    one = vicon_datastream.packet(vicon_datastream.block(BlockKind.REQUEST_NEXT_FRAME))
    vicon = ViconTwin(["cf1", "kh1"])
    t = 0.0

    def take(data):
        nonlocal t
        t += 0.01
        wire = Wire()
        vicon.clients = {wire: _Client()}
        wire.waiting += [data[:3000], data[3000:]] if len(data) > 3000 else [data]
        while wire.waiting and wire in vicon.clients:
            vicon.serve(wire, t)
        vicon.advance(t)

    yield Target(
        [vicon_datastream.pack_kinds(vicon_datastream.POSES) + ask, ask, one, vicon_datastream.packet() + one + one],
        take,
    )
    vicon.clients.clear()
    vicon.close()


PLACES = {
    "khepera-twin": Place(khepera_twin, 20_000, 100),
    "khepera-bridge": Place(khepera_bridge, 30_000),
    "vicon-bridge": Place(vicon_bridge, 50_000),
    "vicon-twin": Place(vicon_twin, 20_000),
}
