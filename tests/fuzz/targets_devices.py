"""Whatever devices say to bridges, and clients to protocol twins: CRTP, DataStream, words of Tello and Khepera, CDR."""

from __future__ import annotations

import importlib.util
import struct
import sys
import types
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from agents.keys import Keys
from agents.protocols import crtp, datastream, ros2
from agents.protocols.crtp import HighLevel, Log, Misc, Port, Safety, Setpoint
from agents.protocols.datastream import Kind, Segment
from tests.fuzz.loopnet import Net, Sample
from tests.fuzz.target import Place, Renewed, Target
from tests.fuzz.targets_network import request
from tests.twins.loopback import request as twin_request
from twins.device import Device, DeviceRequest, Faults


class Wire:
    """A socket that is fed by hand."""

    def __init__(self) -> None:
        self.waiting: deque[bytes] = deque()

    def recvfrom(self, most: int) -> tuple[bytes, tuple[str, int]]:
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.popleft()[:most], ("127.0.0.1", 9)

    def recv(self, most: int) -> bytes:
        return self.recvfrom(most)[0]

    def sendto(self, packet: bytes, _to: object = None) -> int:
        assert isinstance(packet, bytes | bytearray)
        return len(packet)

    send = sendto

    def close(self) -> None:
        pass

    def setsockopt(self, *_: object) -> None:
        pass

    setblocking = setsockopt

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", 1


# ---------------------------------------------------------------------- the Crazyflie


def crazyflie_twin() -> Iterator[Target]:
    """CRTP packets, one or more behind each other (length, bytes), in the air and on the ground."""
    from twins.crazyflie import open_device  # noqa: PLC0415

    def packet(port: Port, channel: int, data: bytes) -> bytes:
        return bytes((1 + len(data), crtp.header(port, channel))) + data

    climb = crtp.CLIMB.pack(0.5, 0.0, True, 1.0)
    pose = crtp.POSE.pack(0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)
    full = crtp.FULL_STATE.pack(100, 200, 300, 0, 0, 0, 0, 0, 0, 0xC0000000, 0, 0, 0)
    arm = packet(Port.SUPERVISOR, 1, bytes((Safety.ARM, 1)))
    up = arm + packet(Port.HIGH_LEVEL, 0, bytes((HighLevel.TAKEOFF, 0)) + climb)
    examples = [
        packet(Port.LINK, 1, b"hello"), b"\1\xff", packet(Port.PLATFORM, 1, b"\0"), packet(Port.LINK, 0, b"echo"),
        *(packet(port, 0, bytes((toc,)) + b"\1\0") for port in (Port.PARAM, Port.LOG) for toc in (2, 3)),
        packet(Port.PARAM, 1, b"\3\0"), packet(Port.PARAM, 2, b"\3\0" + struct.pack("<f", 1.0)),
        packet(Port.PARAM, 3, bytes((Misc.SET_BY_NAME,)) + b"stabilizer\0estimator\0\x08\2"),
        packet(Port.PARAM, 3, bytes((Misc.SET_BY_NAME,)) + b"kalman\0resetEstimation\0\x08\1"),
        *(packet(Port.PARAM, 3, bytes((kind,)) + b"\5\0") for kind in Misc),
        packet(Port.LOG, 1, bytes((Log.RESET,))) + packet(Port.LOG, 1, bytes((Log.CREATE, 1, 7, 0, 0, 7, 1, 0)))
        + packet(Port.LOG, 1, bytes((Log.START, 1, 1))),
        packet(Port.LOG, 1, bytes((Log.APPEND, 1, 3, 9, 0))), packet(Port.LOG, 1, bytes((Log.STOP, 1))),
        packet(Port.MEMORY, 0, b"\1"), packet(Port.MEMORY, 0, b"\2\1"),
        *(packet(Port.MEMORY, 1, crtp.MEMORY.pack(k, 0) + b"\x10") for k in range(4)),
        *(packet(Port.MEMORY, 2, crtp.MEMORY.pack(k, 0) + bytes(16)) for k in range(4)),
        up, up + packet(Port.HIGH_LEVEL, 0, bytes((HighLevel.GO_TO, 0)) + crtp.GO_TO.pack(True, False, 0.1,
        0.2, 0.3, 1.0, 1.0)),
        up + packet(Port.HIGH_LEVEL, 0, bytes((HighLevel.LAND, 0)) + climb), packet(Port.HIGH_LEVEL, 0, b"\3\0"),
        arm + packet(Port.SETPOINT, 0, bytes((Setpoint.POSITION,)) + crtp.FOUR.pack(0.1, 0.2, 0.5, 90.0)),
        *(arm + packet(Port.SETPOINT, 0, bytes((kind,)) + crtp.FOUR.pack(0.1, 0.1, 0.1, 0.5)) for kind in Setpoint),
        arm + packet(Port.SETPOINT, 0, bytes((Setpoint.FULL_STATE,)) + full), packet(Port.SETPOINT, 1, b"\0\0\0\0\0"),
        arm + packet(Port.COMMANDER, 0, crtp.THRUST.pack(0.0, 0.0, 10.0, 40000)),
        packet(Port.LOCATION, 0, crtp.VECTOR.pack(0.1, 0.2, 0.3)), packet(Port.LOCATION, 1, b"\x08" + pose),
        packet(Port.LOCATION, 1, b"\2\1\1" + crtp.VECTOR.pack(0.1, 0.2, 0.3)), packet(Port.LOCATION, 1,
        b"\x0b\3\0\3\0"),
        packet(Port.LOCATION, 1, b"\3"), packet(Port.LOCATION, 1, b"\4"),
        *(packet(Port.SUPERVISOR, 1, bytes((kind, 1))) for kind in Safety), packet(Port.SUPERVISOR, 0, b"\x0c"),
    ]  # fmt: skip

    def make():
        nonlocal device
        if device is not None:
            device.close()
        device = open_device(DeviceRequest(twin_request("crazyflie", ["crazyflie-twin"]), Faults()))
        line, wire = device.lines[0], Wire()
        own = line.socket
        line.socket.close()
        line.socket = wire  # type: ignore[assignment]
        t = 0.0

        def take(data: bytes) -> None:
            nonlocal t
            at = 0
            while at < len(data) and len(wire.waiting) < 40:
                wire.waiting.append(data[at + 1 : at + 1 + data[at]] or b"\0")
                at += 1 + data[at]
            while wire.waiting:
                device.serve(own, t)
            for _ in range(3):
                t += 0.01
                device.advance(t)
            position, _ = device.truth()
            assert np.isfinite(position).all()

        return take

    device: Any = None
    yield Target(examples, Renewed(make, 100))
    device.close()


# ---------------------------------------------------------------------- the Tello


def tello_twin() -> Iterator[Target]:
    """Words over UDP, datagrams apart by zero bytes."""
    from twins.tello import open_device  # noqa: PLC0415

    words = [
        "command", "takeoff", "land", "emergency", "stop", "rc 10 -20 30 40", "rc 100 100 100 100", "up 50", "back 100",
        "cw 90", "ccw 360", "go 50 60 70 50", "speed 20", "battery?", "attitude?", "tof?", "sn?", "wifi?", "streamon",
        "flip l", "curve 1 2 3 4 5 6 20", "jump 1 2 3 4 5 m1 m2", "mon", "time?", "speed?", "height?", "baro?", "sdk?",
    ]  # fmt: skip
    examples = [b"command", *(f"command\0takeoff\0\0{word}".encode() for word in words)]

    def make():
        nonlocal device
        if device is not None:
            device.close()
        device = open_device(DeviceRequest(twin_request("tello", ["tello-twin"]), Faults()))
        wire = Wire()
        device._drones[0].wire.close()
        device._drones[0].wire = wire
        t = 0.0

        def take(data: bytes) -> None:
            nonlocal t
            wire.waiting += data.split(b"\0")[:20]
            while wire.waiting:
                device.serve(wire, t)
                for _ in range(2):
                    t += 0.01
                    device.advance(t)
            assert np.isfinite(device.truth()[0]).all()

        return take

    device: Any = None
    yield Target(examples, Renewed(make, 100))
    device.close()


class Drone:
    """What djitellopy shows of a drone, parsed by djitellopy itself."""

    def __init__(self) -> None:
        self.state: dict[str, Any] = {}
        self.responses: list[bytes] = []

    def send_rc_control(self, *sticks: int) -> None:
        assert all(isinstance(stick, int) and -100 <= stick <= 100 for stick in sticks)

    def send_command_without_return(self, command: str) -> None:
        assert command

    def get_current_state(self) -> dict[str, Any]:
        return self.state

    def get_own_udp_object(self) -> dict[str, Any]:
        return {"responses": self.responses, "state": self.state}

    def end(self) -> None:
        pass


def tello_pilot() -> Iterator[Target]:
    """A drone's state lines and answers: state and answer with a zero byte between them."""
    from agents.kinds import KINDS  # noqa: PLC0415
    from agents.protocols.tello import Settings  # noqa: PLC0415
    from bridges.tello_pilot import Pilot  # noqa: PLC0415

    if "av" not in sys.modules and importlib.util.find_spec("av") is None:
        sys.modules["av"] = types.ModuleType("av")  # only its video would need it, see `bridges.tello`
    import djitellopy.tello  # noqa: PLC0415

    djitellopy.tello.Tello.LOGGER.setLevel("CRITICAL")  # it says every line that it cannot read
    parse = djitellopy.tello.Tello.parse_state
    line = (
        b"mid:-1;x:-100;y:-100;z:-100;mpry:0,0,0;pitch:0;roll:0;yaw:12;vgx:0;vgy:0;vgz:0;templ:63;temph:66;tof:50;"
        b"h:40;bat:80;baro:170.80;time:12;agx:-6.00;agy:1.00;agz:-999.00;\r\n"
    )
    examples = [
        line + b"\0" + answer
        for answer in (b"ok", b"error", b"out of range", b"unknown command: x", b"error Auto land")
    ]

    def make():
        drone = Drone()
        pilot = Pilot(drone, KINDS["tello"], Settings())
        pilot.position = (0.0, 0.0, 0.5)
        now = 100.0

        def take(data: bytes) -> None:
            nonlocal now
            now += 0.05
            state, _, answer = data.partition(b"\0")
            try:
                parsed = parse(state.decode("ascii"))
            except (UnicodeDecodeError, ValueError, IndexError, KeyError, TypeError):
                parsed = drone.state  # its thread says so and goes on
            drone.state = parsed
            drone.responses.append(answer)
            if len(data) % 8 == 0:
                pilot.rise(0.5, now)
            pilot.step(now, now)
            assert isinstance(pilot.note(now), str)

        return take

    yield Target(examples, Renewed(make, 200))


# ---------------------------------------------------------------------- the Khepera IV


def khepera_twin() -> Iterator[Target]:
    """Both protocols: the first byte says which."""
    from twins import khepera4  # noqa: PLC0415

    park = ["d 10.0 0.5", "stop", "p", "t", "get_data", "g 1.0 0.5", "i 0.1 0.2 0.3", "d -81.0 -7"]
    kteam = ["B", "D,100,-100", "R", "G", "N", "O", "V,5", "U,31", "I", "E", "S", "T", "M,1,2", "K", "H", "J"]
    examples = [b"p" + word.encode() for word in park] + [b"k" + "\r".join([word, "R", ""]).encode() for word in kteam]

    def make():
        nonlocal devices
        for device in devices.values():
            device.close()
        devices = {}
        for protocol in ("park", "kteam"):
            made = twin_request("khepera4", ["khepera4-twin"], device={"protocol": protocol})
            devices[protocol[0]] = khepera4.open_device(DeviceRequest(made, Faults()))
        t = 0.0

        def take(data: bytes) -> None:
            nonlocal t
            device: Any = devices["k" if data[:1] == b"k" else "p"]
            wire = Wire()
            server = device._servers[0]
            server._client = wire
            wire.waiting += [data[1:256], data[256:512]] if len(data) > 256 else [data[1:]]
            while wire.waiting:
                device.serve(wire, t)
            for _ in range(2):
                t += 0.01
                device.advance(t)
            assert np.isfinite(device.truth()[0]).all()

        return take

    devices: dict[str, Device] = {}
    yield Target(examples, Renewed(make, 200))
    for device in devices.values():
        device.close()


def khepera_bridge() -> Iterator[Target]:
    """Answers of both servers to everything that the link asks, apart by zero bytes."""
    from agents.protocols.khepera4 import Settings  # noqa: PLC0415
    from bridges.khepera4_link import KTeam, Park  # noqa: PLC0415
    from bridges.odometry import Odometer  # noqa: PLC0415

    class Line:
        def __init__(self, parts: list[bytes]) -> None:
            self.parts = deque(parts)

        def send(self, data: bytes) -> None:
            assert data

        def receive(self, _until: float) -> bytes:
            if not self.parts:
                raise TimeoutError
            return self.parts.popleft()[:1024]

    park = [b"0.1,0.2,0.3", b"1000,1000,50,1000,1000"]
    kteam = [b"b,C,4\r\n", b"u\r\n", b"d\r\n", b"r,100,-100\r\n", b"g,1000,1000,50,1000,2000\r\n",
        b"n,40,40,40,40,40,40,40,900,1,1,1,1\r\n", b"v,80\r\n"]  # fmt: skip
    examples = [b"p\0" + b"\0".join(park), b"s\0" + park[0][:7], b"k\0" + b"\0".join(kteam)]

    def take(data: bytes) -> None:
        which, *parts = data.split(b"\0")
        line: Any = Line(parts)
        odometer = Odometer(0.0, 0.0, 0.0)
        driver: Park | KTeam
        if which[:1] == b"k":
            driver = KTeam(line, Settings())
        else:
            driver = Park(line, Settings(odometry="pose" if which[:1] == b"p" else "increments"))
            driver._free = -np.inf
            driver._say = line.send  # type: ignore[method-assign]  # without the pause
        driver.begin()
        if isinstance(driver, KTeam):
            driver.drive(0.1, 0.2)
        driver.move(odometer)
        assert np.isfinite((odometer.x, odometer.y, odometer.yaw)).all()
        _, distance = driver.ranges()
        assert not np.isinf(distance).any()
        driver.battery()

    yield Target(examples, take, (OSError,))


# ---------------------------------------------------------------------- the Vicon


def _vicon_stream() -> list[bytes]:
    names = b"".join([datastream.pack_stream_info(100.0), datastream.pack_axes(), *(
        datastream.pack_subject(k, name) for k, name in enumerate(("cf1", "kh1")))])  # fmt: skip
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    frames = []
    for number in range(3):
        parts = [datastream.pack_frame_number(number), datastream.pack_latency([("a", 0.002), ("b", 0.001)])]
        parts += [datastream.pack_segments(k, [Segment(0, (0.1 * number, 0.2, 0.3), eye)]) for k in range(2)]
        frames.append(b"".join(parts))
    return [
        datastream.packet(names, frames[0]), datastream.packet(names, frames[0]) + datastream.packet(frames[1]),
        datastream.packet(frames[1]), datastream.packet(names), datastream.packet(names,
        datastream.pack_axes(1), frames[2]),
        datastream.pack_kinds(datastream.POSES),
    ]  # fmt: skip


def vicon_bridge() -> Iterator[Target]:
    """What a DataStream server sends, in chunks."""
    from bridges.datastream import Decoder  # noqa: PLC0415
    from bridges.vicon import Sieve  # noqa: PLC0415

    def make():
        decoder, sieve, t = Decoder(), Sieve({"CF01": "cf1", "KH01": "kh1"}, lambda _: None), 0.0

        def take(data: bytes) -> None:
            nonlocal t
            t += 0.01
            framer = datastream.Framer()  # the connection is made anew after every error
            for begin in range(0, len(data), 4000):
                for body in framer.feed(data[begin : begin + 4000]):
                    for kind, payload in datastream.blocks(body):
                        if kind == Kind.OBJECT_ENUMS:
                            datastream.unpack_kinds(payload)
                    frame = decoder.frame(body)
                    if frame is not None:
                        for _, measured, segment, yaw in sieve.sift(frame, t):
                            assert np.isfinite((measured, yaw, *segment.position)).all()

        return take

    yield Target(_vicon_stream(), Renewed(make, 300), (datastream.Malformed,))


def vicon_twin() -> Iterator[Target]:
    """What a client sends to the server."""
    from twins.vicon import ViconTwin, _Client  # noqa: PLC0415

    ask = datastream.packet(datastream.block(Kind.REQUEST_FRAME, b"\1"))
    one = datastream.packet(datastream.block(Kind.REQUEST_NEXT_FRAME))
    vicon = ViconTwin(["cf1", "kh1"])
    t = 0.0

    def take(data: bytes) -> None:
        nonlocal t
        t += 0.01
        wire: Any = Wire()
        vicon._clients = {wire: _Client()}
        wire.waiting += [data[:3000], data[3000:]] if len(data) > 3000 else [data]
        while wire.waiting and wire in vicon._clients:
            vicon.serve(wire, t)
        vicon.advance(t)

    yield Target([datastream.pack_kinds(datastream.POSES) + ask, ask, one, datastream.packet() + one + one], take)
    vicon._clients.clear()
    vicon.close()


# ---------------------------------------------------------------------- ROS 2


def ros_messages() -> dict[str, bytes]:
    """A good message of each type that is read, as CDR."""
    types = ros2.types("jazzy")
    make = types.make
    header = types.header(1.7e9, "map")
    point, turn = (
        make("geometry_msgs/msg/Point", x=0.1, y=0.2, z=0.0),
        make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.1, w=1.0),
    )
    pose = make("geometry_msgs/msg/Pose", position=point, orientation=turn)
    twist = types.twist((0.1, 0.0, 0.0), (0.0, 0.0, 0.2))
    sides = np.zeros(36)
    found = {
        ros2.TWIST: twist,
        ros2.TWIST_STAMPED: make(ros2.TWIST_STAMPED, header=header, twist=twist),
        ros2.POSE_STAMPED: make(ros2.POSE_STAMPED, header=header, pose=pose),
        ros2.ODOMETRY: make(
            ros2.ODOMETRY, header=header, child_frame_id="base_footprint",
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=sides),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=sides),
        ),
        ros2.LASER_SCAN: make(
            ros2.LASER_SCAN, header=header, angle_min=0.0, angle_max=6.0, angle_increment=0.5, time_increment=0.001,
            scan_time=0.2, range_min=0.12, range_max=3.5, ranges=np.full(12, 1.5, np.float32),
            intensities=np.zeros(12, np.float32),
        ),
        ros2.BATTERY_STATE: make(
            ros2.BATTERY_STATE, header=header, voltage=11.0, temperature=0.0, current=0.0, charge=0.0, capacity=0.0,
            design_capacity=1.8, percentage=55.0, power_supply_status=0, power_supply_health=0,
            power_supply_technology=0, present=True, cell_voltage=np.zeros(3, np.float32),
            cell_temperature=np.zeros(0, np.float32), location="", serial_number="",
        ),
    }  # fmt: skip
    return {kind: types.encode(message, kind) for kind, message in found.items()}


def ros() -> Iterator[Target]:
    """CDR of every type, tokens and attachments: kind and payload with a zero byte between them."""
    types = ros2.types("jazzy")
    good = ros_messages()
    tokens = [
        ros2.endpoint_token(0, "f00d", 0, 1, "MP", "tb3_0", "node", ros2.endpoint_topic("/tb3_0/odom",
        ros2.ODOMETRY, ros2.RELIABLE, types)),
        ros2.dds_token("f00d", "MS", "/tb3_0/cmd_vel", ros2.TWIST),
    ]  # fmt: skip
    examples = [kind.encode() + b"\0" + payload for kind, payload in good.items()]
    examples += [b"token\0" + token.encode() for token in tokens] + [b"attached\0" + ros2.attachment(1, 2, bytes(16))]

    def take(data: bytes) -> None:
        head, _, rest = data.partition(b"\0")
        kind = head.decode("utf-8", "replace")
        if kind == "token":
            for style in ("rmw", "ros2dds"):
                ros2.announced(style, rest.decode("utf-8", "replace"))  # type: ignore[arg-type]
        elif kind == "attached":
            ros2.attached(rest)
        elif kind in good:
            types.decode(rest, kind)

    yield Target(examples, take, (ValueError,))


def turtlebot_bridge() -> Iterator[Target]:
    """Odometry, scans, batteries and tokens of a robot."""
    from bridges.turtlebot3 import TurtleBot3  # noqa: PLC0415

    good = ros_messages()
    topics = {"odom": ros2.ODOMETRY, "scan": ros2.LASER_SCAN, "battery_state": ros2.BATTERY_STATE}
    examples = [f"tb3_0/{topic}\0\0".encode() + good[kind] for topic, kind in topics.items()]
    examples += [ros2.dds_token("f00d", "MS", "/tb3_0/cmd_vel", ros2.TWIST_STAMPED).encode() + b"\0\0"]

    def make():
        net.forget()
        net.first["tb3_0/odom"] = Sample("tb3_0/odom", "", good[ros2.ODOMETRY])
        body = TurtleBot3(request("turtlebot3", "ros2dds://tb3_0"))
        body.open()
        t = 0.0

        def take(data: bytes) -> None:
            nonlocal t
            t += 0.01
            net.deliver(data, gone=len(data) % 16 == 0)
            state = body.read(t)
            assert np.isfinite(state.position).all()
            body.command(np.array([[0.1, 0.2, 0.0, 0.0]]))

        return take

    with Net().worn() as net:
        yield Target(examples, Renewed(make, 200))


def turtlebot_twin() -> Iterator[Target]:
    """Commands to the twin of a robot."""
    from twins.turtlebot3 import open_device  # noqa: PLC0415

    good = ros_messages()

    def make():
        net.forget()
        device = open_device(DeviceRequest(request("turtlebot3", "turtlebot3-twin"), Faults()))
        t = 0.0

        def take(data: bytes) -> None:
            nonlocal t
            t += 0.01
            net.deliver(data)
            device.advance(t)
            assert np.isfinite(device.truth()[0]).all()

        return take

    with Net().worn() as net:
        yield Target([b"KH01/cmd_vel\0\0" + good[ros2.TWIST_STAMPED]], Renewed(make, 300))


def ros_graph() -> Iterator[Target]:
    """The bridge to ROS 2: states and statuses of robots, goals from ROS."""
    from agents.rosnode import Participant  # noqa: PLC0415
    from bridges.ros2 import Graph  # noqa: PLC0415
    from tests.fuzz.messages import everything  # noqa: PLC0415

    good = ros_messages()
    examples = everything("KH01", "KH02", only=("state", "status"))

    def make():
        net.forget()
        participant = Participant(net.session, ros2.types("jazzy"), style="rmw")  # type: ignore[arg-type]
        graph = Graph(net.session, participant, Keys())  # type: ignore[arg-type]
        net.deliver(b"park/KH01/alive\0\0")
        graph.poll()

        def take(data: bytes) -> None:
            net.deliver(data, gone=len(data) % 16 == 0)
            graph.poll()

        return take

    with Net().worn() as net:
        make()
        goals = [channel.key for channel in net.channels if "/goal" in channel.key]
        examples += [key.encode() + b"\0\0" + good[ros2.POSE_STAMPED] for key in goals]
        yield Target(examples, Renewed(make, 200))


PLACES = {
    "crazyflie-twin": Place(crazyflie_twin, 40_000, 150),
    "tello-twin": Place(tello_twin, 20_000, 100),
    "tello-pilot": Place(tello_pilot, 20_000),
    "khepera-twin": Place(khepera_twin, 20_000, 100),
    "khepera-bridge": Place(khepera_bridge, 30_000),
    "vicon-bridge": Place(vicon_bridge, 50_000),
    "vicon-twin": Place(vicon_twin, 20_000),
    "ros": Place(ros, 40_000),
    "turtlebot-bridge": Place(turtlebot_bridge, 20_000),
    "turtlebot-twin": Place(turtlebot_twin, 10_000, 100),
    "ros-graph": Place(ros_graph, 20_000),
}
