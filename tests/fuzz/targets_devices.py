"""Bytes from and to Khepera IV robots and a Vicon."""

from contextlib import ExitStack, closing
from itertools import count
from types import SimpleNamespace
from unittest import mock

import numpy as np

from agents.protocols import khepera4
from agents.protocols import vicon_datastream as vicon
from agents.protocols.vicon_datastream import BlockKind, Segment
from bridges.khepera4.drivers import KTeam, identify
from bridges.khepera4.odometry import Odometer
from bridges.vicon.client import Decoder
from bridges.vicon.publisher import PoseFilter
from tests.fuzz.target import Target, Wire, place, renewed
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


@renewed(200, khepera_orders, 20_000, 100)
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


@place(30_000)
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

        def receive(_until):
            if not parts:
                raise TimeoutError
            return parts.pop(0)[:1024]

        def send(request):
            assert request

        line = SimpleNamespace(send=send, pending=bytes, receive=receive)
        odometer = Odometer(0.0, 0.0, 0.0)
        with mock.patch.object(khepera4, "GAP_S", 0.0):  # without the pauses
            if which[:1] == b"k":
                driver, speeds = KTeam(line, khepera4.Khepera4Settings()), [0.1]
            else:
                driver, speeds = identify(line, khepera4.Khepera4Settings(), named.get(which[:1])), [0.1, -0.1]
            driver.begin()
            for speed in speeds:
                driver.drive(speed, 0.2)
                driver.move(odometer)
        assert np.isfinite((odometer.x, odometer.y, odometer.yaw)).all()
        _, distance = driver.ranges()
        assert not np.isinf(distance).any()
        driver.battery()

    yield Target(examples, take, (OSError,))


def _vicon_stream():
    subjects = [vicon.pack_subject(k, name) for k, name in enumerate(("cf1", "kh1"))]
    names = b"".join([vicon.pack_stream_info(100.0), vicon.pack_axes(), *subjects])
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    latency = vicon.pack_latency([("a", 0.002), ("b", 0.001)])
    frames = []
    for number in range(3):
        parts = [vicon.pack_segments(k, [Segment(0, (0.1 * number, 0.2, 0.3), eye)]) for k in range(2)]
        frames.append(vicon.pack_frame_number(number) + latency + b"".join(parts))
    return [
        vicon.packet(names, frames[0]),
        vicon.packet(names, frames[0]) + vicon.packet(frames[1]),
        vicon.packet(frames[1]),
        vicon.packet(names),
        vicon.packet(names, vicon.pack_axes(1), frames[2]),
        vicon.pack_kinds(vicon.POSES),
    ]


@renewed(300, _vicon_stream, 50_000, refusals=(vicon.MalformedBlock,))
def vicon_bridge():
    """Output of a DataStream server, in chunks."""
    decoder, pose_filter = Decoder(), PoseFilter({"CF01": "cf1", "KH01": "kh1"}, lambda _: None)
    for k in count(1):
        data = yield
        framer = vicon.Framer()  # the connection is made anew after every error
        for begin in range(0, len(data), 4000):
            for body in framer.feed(data[begin : begin + 4000]):
                for kind, payload in vicon.blocks(body):
                    if kind == BlockKind.OBJECT_ENUMS:
                        vicon.unpack_kinds(payload)
                frame = decoder.frame(body)
                if frame is not None:
                    for _, measured, segment, yaw in pose_filter.filter_poses(frame, 0.01 * k):
                        assert np.isfinite((measured, yaw, *segment.position)).all()


@place(20_000)
def vicon_twin():
    """Requests of a client to the server."""
    ask = vicon.packet(vicon.block(BlockKind.REQUEST_FRAME, b"\1"))
    one = vicon.packet(vicon.block(BlockKind.REQUEST_NEXT_FRAME))
    ticks = count(1)

    def take(data):
        t, wire = 0.01 * next(ticks), Wire()
        twin.clients = {wire: _Client()}
        wire.waiting += [data[:3000], data[3000:]] if len(data) > 3000 else [data]
        while wire.waiting and wire in twin.clients:
            twin.serve(wire, t)
        twin.advance(t)

    with closing(ViconTwin(["cf1", "kh1"])) as twin:
        yield Target([vicon.pack_kinds(vicon.POSES) + ask, ask, one, vicon.packet() + one + one], take)
        twin.clients.clear()
