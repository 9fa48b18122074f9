"""Bytes from and to Crazyflies, Tellos, Khepera IV robots and a Vicon."""

import importlib.util
import socket
import sys
from contextlib import ExitStack, closing, suppress
from itertools import count
from types import ModuleType, SimpleNamespace
from unittest import mock

import numpy as np

from agents.body.byte_stream import MalformedStream
from agents.body.kinds import KINDS
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crtp import HighLevel, Log, Misc, Port, Setpoint, SupervisorCommand
from bridges.crazyflie.twin.device import CrazyflieTwin
from bridges.khepera4 import protocol as khepera4
from bridges.khepera4.drivers import KTeam, identify
from bridges.khepera4.odometry import Odometer
from bridges.khepera4.twin import KheperaDevice
from bridges.motion_capture.protocol import natnet, qtm
from bridges.motion_capture.protocol import vicon_datastream as vicon
from bridges.motion_capture.protocol.natnet import MessageKind, NatNetFrame, RigidBodyPose, ServerInfo
from bridges.motion_capture.protocol.qtm import BodyPose, QtmFrame, QtmPacketKind
from bridges.motion_capture.protocol.vicon_datastream import BlockKind, Segment
from bridges.motion_capture.publisher import PoseFilter
from bridges.motion_capture.twin.vicon import ViconTwin
from bridges.motion_capture.vicon import Decoder
from bridges.tello.pilot import TelloPilot
from bridges.tello.protocol import TelloSettings
from bridges.tello.twin import TelloDevice
from tests.fuzz.target import Target, Wire, place, renewed
from tests.requests import request
from twins.device import DeviceRequest, Faults

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
            wire.queue += [data[1:256], data[256:512]] if len(data) > 256 else [data[1:]]
            while wire.queue:
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
                server = named.get(which[:1])
                driver = identify(line, khepera4.Khepera4Settings(), server, over=lambda: not parts)
                speeds = [0.1, -0.1]
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


@renewed(300, _vicon_stream, 50_000, refusals=(MalformedStream,))
def vicon_bridge():
    """Output of a DataStream server, in chunks."""
    decoder, pose_filter = Decoder(), PoseFilter({"CF01": "cf1", "KH01": "kh1"}, lambda _: None)
    for k in count(1):
        data = yield
        framer = vicon.framer()  # the connection is made anew after every error
        for begin in range(0, len(data), 4000):
            for _, body in framer.feed(data[begin : begin + 4000]):
                for kind, payload in vicon.blocks(body):
                    if kind == BlockKind.OBJECT_ENUMS:
                        vicon.unpack_kinds(payload)
                frame = decoder.frame(body)
                if frame is not None:
                    for _, measured, position, yaw in pose_filter.filter_poses(frame, 0.01 * k):
                        assert np.isfinite((measured, yaw, *position)).all()


def _natnet_packets():
    bodies = [RigidBodyPose(k, (0.1 * k, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0), True) for k in (1, 2)]
    packets = []
    for version in ((3, 0), (4, 0), (4, 2)):
        frame = natnet.pack_frame(NatNetFrame(7, bodies, 1, 2, 3), version)
        names = natnet.pack_descriptions({1: "cf1", 2: "kh1"}, version)
        packets += [natnet.message(MessageKind.FRAME, frame), natnet.message(MessageKind.DESCRIPTIONS, names)]
    info = ServerInfo("Motive", (4, 2), natnet.CLOCK_HZ, natnet.DATA_PORT, natnet.GROUP)
    return [*packets, natnet.message(MessageKind.SERVER_INFO, natnet.pack_server_info(info))]


@place(30_000)
def natnet_packets():
    """Packets of a NatNet server, of any version."""

    def take(data):
        kind, body = natnet.unpack_message(data)
        if kind == MessageKind.SERVER_INFO:
            natnet.unpack_server_info(body)
            return
        unpack = natnet.unpack_frame if kind == MessageKind.FRAME else natnet.unpack_descriptions
        for version in ((3, 0), (4, 0), (4, 2)):
            with suppress(MalformedStream):
                unpack(body, version)

    yield Target(_natnet_packets(), take, (MalformedStream,))


@place(30_000)
def qtm_packets():
    """Output of QTM's real-time server."""
    hidden = BodyPose((np.nan,) * 3, (np.nan,) * 9)
    frame = qtm.pack_frame(QtmFrame(1.0, 3, [BodyPose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0) * 3), hidden]))
    names = qtm.command(qtm.pack_parameters(["cf1", "kh1"], 100.0), QtmPacketKind.XML)

    def take(data):
        for kind, payload in qtm.framer().feed(data):
            if kind == QtmPacketKind.XML:
                qtm.unpack_parameters(payload)
            elif kind == QtmPacketKind.DATA:
                qtm.unpack_frame(payload)

    yield Target([frame, names, frame + names, qtm.command(qtm.WELCOME) + frame], take, (MalformedStream,))


@place(20_000)
def vicon_twin():
    """Requests of a client to the server."""
    ask = vicon.packet(vicon.block(BlockKind.REQUEST_FRAME, b"\1"))
    one = vicon.packet(vicon.block(BlockKind.REQUEST_NEXT_FRAME))
    ticks = count(1)

    def take(data):
        t, wire = 0.01 * next(ticks), Wire()
        twin.clients = {wire: twin.new_client()}
        wire.queue += [data[:3000], data[3000:]] if len(data) > 3000 else [data]
        while wire.queue and wire in twin.clients:
            twin.serve(wire, t)
        twin.advance(t)

    with closing(ViconTwin(["cf1", "kh1"])) as twin:
        yield Target([vicon.pack_kinds(vicon.POSES) + ask, ask, one, vicon.packet() + one + one], take)
        twin.clients.clear()


def packet(port, channel, data):
    return bytes((1 + len(data), crtp.header(port, channel))) + data


def crtp_packets():
    climb = crtp.CLIMB.pack(0.5, 0.0, True, 1.0)
    pose = crtp.POSE.pack(0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)
    full = crtp.FULL_STATE.pack(100, 200, 300, 0, 0, 0, 0, 0, 0, 0xC0000000, 0, 0, 0)
    arm = packet(Port.SUPERVISOR, 1, bytes((SupervisorCommand.ARM, 1)))

    def high(command, data=b""):
        return packet(Port.HIGH_LEVEL, 0, bytes((command, 0)) + data)

    def trajectory(at, points, number, define, start):
        written = packet(Port.MEMORY, 2, crtp.MEMORY.pack(4, at) + points)
        defined = packet(Port.HIGH_LEVEL, 0, bytes((HighLevel.DEFINE, number)) + crtp.DEFINE.pack(*define))
        return written + up + defined + start

    up = arm + high(HighLevel.TAKEOFF, climb)
    log = ((Log.RESET,), (Log.CREATE, 1, 7, 0, 0, 7, 1, 0), (Log.START, 1, 1), (Log.APPEND, 1, 3, 9, 0), (Log.STOP, 1))
    start, start_2 = crtp.START.pack(1, 1, 2, 0.5), crtp.START_2.pack(1, 1, 0, 1, 1.0)
    flights = [
        up,
        up + high(HighLevel.GO_TO, crtp.GO_TO.pack(True, False, 0.1, 0.2, 0.3, 1.0, 1.0)),
        up + high(HighLevel.LAND, climb),
        up + high(HighLevel.SPIRAL, crtp.SPIRAL.pack(0, 1, 1.0, 0.5, 0.6, 0.1, 1.0)),
        trajectory(0, bytes((1, 0, 2, 0, 3, 0, 4, 0, 9, 100, 0)), 1, (1, 1, 0, 1), high(HighLevel.START_2, start_2)),
        trajectory(128, b"\0\0\x80\x3f", 2, (1, 0, 0, 1), high(HighLevel.START, start)),
        *(arm + packet(Port.SETPOINT, 0, bytes((kind,)) + crtp.FOUR.pack(0.1, 0.1, 0.1, 0.5)) for kind in Setpoint),
        arm + packet(Port.SETPOINT, 0, bytes((Setpoint.FULL_STATE,)) + full),
        arm + packet(Port.COMMANDER, 0, crtp.THRUST.pack(0.0, 0.0, 10.0, 40000)),
        packet(Port.LOCATION, 0, crtp.VECTOR.pack(0.1, 0.2, 0.3)),
        packet(Port.LOCATION, 1, b"\x08" + pose),
        packet(Port.LOCATION, 1, b"\2\1\1" + crtp.VECTOR.pack(0.1, 0.2, 0.3)),
        packet(Port.LINK, 1, b"hello") + b"\1\xff",
        b"".join(packet(Port.LOG, 1, bytes(words)) for words in log),
        packet(Port.PARAM, 3, bytes((Misc.SET_BY_NAME,)) + b"stabilizer\0estimator\0\x08\2"),
        packet(Port.PARAM, 3, bytes((Misc.SET_BY_NAME,)) + b"kalman\0resetEstimation\0\x08\1"),
        *(packet(Port.LINK, 3, bytes((crtp.NRF, command))) for command in crtp.PowerSwitch),
        *(packet(Port.MEMORY, channel, crtp.MEMORY.pack(k, 0) + bytes(16)) for channel in (1, 2) for k in range(9)),
    ]
    heads = [(port, channel, first) for port in Port for channel in range(4) for first in range(10)]
    return (
        flights * 20
        + flights[:6] * 60
        + [packet(port, channel, bytes((first, 1, 0))) for port, channel, first in heads]
    )


@renewed(100, crtp_packets, 40_000, 150)
def crazyflie_twin():
    """CRTP packets, one or more behind each other (length, bytes), in the air and on the ground."""
    with closing(CrazyflieTwin(DeviceRequest(request("crazyflie", "crazyflie-twin"), Faults()))) as device:
        line, wire = device.lines[0], Wire()
        own = line.socket
        line.socket.close()
        line.socket = wire
        for k in count():
            data, at = (yield), 0
            while at < len(data) and len(wire.queue) < 40:
                wire.queue.append(data[at + 1 : at + 1 + data[at]] or b"\0")
                at += 1 + data[at]
            while wire.queue:
                device.serve(own, 0.03 * k)
            for step in (1, 2, 3):
                device.advance(0.03 * k + 0.01 * step)
            assert np.isfinite(device.truth()[0]).all()


WORDS = """command,takeoff,land,emergency,stop,rc 10 -20 30 40,rc 100 100 100 100,up 50,back 100,cw 90,ccw 360,
go 50 60 70 50,speed 20,battery?,attitude?,tof?,sn?,wifi?,streamon,flip l,curve 1 2 3 4 5 6 20,
curve 71 29 0 100 100 0 30,go 50 0 0 30 m1,wifi a b,keepalive,jump 1 2 3 4 5 m1 m2,mon,time?,speed?,baro?,sdk?"""


def tello_words():
    return [b"command", *(f"command\0takeoff\0\0{word.strip()}".encode() for word in WORDS.split(","))]


@renewed(100, tello_words, 20_000, 100)
def tello_twin():
    """Words over UDP, datagrams apart by zero bytes."""
    with socket.socket(type=socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        made = DeviceRequest(request("tello", "tello-twin"), Faults())
        with closing(TelloDevice(made, state_port=client.getsockname()[1])) as device:
            (wire,) = device.sockets()
            client.connect(wire.getsockname())
            t = 0.0
            while True:
                for datagram in (yield).split(b"\0")[:20]:
                    client.send(datagram[:1024])
                    device.serve(wire, t)
                    for _ in range(2):
                        t += 0.01
                        device.advance(t)
                assert np.isfinite(device.truth()[0]).all()


LINE = (
    b"mid:-1;x:-100;y:-100;z:-100;mpry:0,0,0;pitch:0;roll:0;yaw:12;vgx:0;vgy:0;vgz:0;templ:63;temph:66;tof:50;"
    b"h:40;bat:80;baro:170.80;time:12;agx:-6.00;agy:1.00;agz:-999.00;\r\n\0"
)
ANSWERS = (b"ok", b"error", b"out of range", b"unknown command: x", b"error Auto land")


def check_sticks(command):
    word, *sticks = command.split()
    assert word != "rc" or [-100 <= int(stick) <= 100 for stick in sticks] == [True] * 4


@renewed(200, lambda: [LINE + answer for answer in ANSWERS], 20_000)
def tello_pilot():
    """A drone's state lines, parsed by djitellopy itself, and answers, with a zero byte between them."""
    if "av" not in sys.modules and importlib.util.find_spec("av") is None:
        sys.modules["av"] = ModuleType("av")  # only its video would need it, see `bridges.tello.library`
    import djitellopy.tello  # noqa: PLC0415

    djitellopy.tello.Tello.LOGGER.setLevel("CRITICAL")  # it says every line that it cannot read
    drone = SimpleNamespace(state={}, responses=[], end=lambda: None, get_current_state=lambda: drone.state)
    drone.get_own_udp_object = lambda: {"responses": drone.responses, "state": drone.state}
    drone.send_command_without_return = check_sticks
    pilot = TelloPilot(drone, KINDS["tello"], TelloSettings())
    pilot.position = (0.0, 0.0, 0.5)
    for k in count(1):
        data, now = (yield), 100.0 + 0.05 * k
        state, _, answer = data.partition(b"\0")
        with suppress(UnicodeDecodeError, ValueError, IndexError, KeyError, TypeError):  # dropped, see `library`
            drone.state = djitellopy.tello.Tello.parse_state(state.decode("ascii"))
        drone.responses.append(answer)
        if len(data) % 8 == 0:
            pilot.take_off(0.5, now)
        pilot.step(now, now)
        assert isinstance(pilot.note(now), str)
