"""What a Crazyflie twin answers: tables, parameters, logs, memories, and what a bad link does to that."""

import math
import socket
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import BodyError, Disturbance, Jitter
from agents.protocols import crtp
from agents.protocols.crtp import (
    NRF,
    Log,
    LogStatus,
    MemoryKind,
    Misc,
    Port,
    PowerSwitch,
    SupervisorCommand,
    Toc,
    header,
)
from tests.twins.crazyflie_wire import Wire
from tests.twins.loopback import request
from twins.body import TwinBody
from twins.devices.crazyflie.device import CrazyflieTwin
from twins.devices.crazyflie.flock import Flock
from twins.devices.crazyflie.memory import ANCHOR_PAGES, CALIBRATION, Memories
from twins.devices.crazyflie.tables import LOG_CODES, PACKINGS, inventory
from twins.devices.device import DeviceRequest, Faults

PARAMETER_TABLE, LOG_TABLE = inventory().parameters, inventory().logs


def number(name):
    return struct.pack("<H", PARAMETER_TABLE.number[name])


def variable(kind, name):
    return struct.pack("<BH", kind, LOG_TABLE.number[name])


# ---------------------------------------------------------------------- who it is, and what it has


def test_greeting_and_version():
    wire = Wire()
    assert wire.put(Port.LINK, 1, 0) == [(Port.LINK, 1, b"Bitcraze Crazyflie".ljust(30, b"\0"))]
    assert wire.put(Port.PLATFORM, 1, 0) == [(Port.PLATFORM, 1, b"\0" + struct.pack("<I", 12))]
    assert wire.put(Port.LINK, 0, b"anything") == [(Port.LINK, 0, b"anything")]
    ((_, _, answer),) = wire.put(Port.SUPERVISOR, 0, int(SupervisorCommand.ASK))
    assert answer[0] == 0x8C
    assert wire.put(Port.SUPERVISOR, 1, int(SupervisorCommand.RECOVER)) == [(Port.SUPERVISOR, 1, b"\x82\1\1")]


@pytest.mark.parametrize(("port", "table"), [(Port.PARAM, PARAMETER_TABLE), (Port.LOG, LOG_TABLE)])
def test_tables(port, table):
    """Count, checksum, and every entry with its last NUL, in one packet each."""
    wire = Wire()
    ((_, _, info),) = wire.put(port, 0, int(Toc.INFO))
    assert struct.unpack("<BHI", info[:7]) == (Toc.INFO, len(table.items), table.crc)
    for i, (name, _) in enumerate(table.number.items()):
        ((_, _, item),) = wire.put(port, 0, int(Toc.ITEM), struct.pack("<H", i))
        assert len(item) <= crtp.MTU
        assert item[4:] == name.replace(".", "\0").encode() + b"\0"
    assert PARAMETER_TABLE.crc != LOG_TABLE.crc  # cflib keeps both in one cache


def test_malformed_packets_are_dropped():
    """A short packet neither kills the device nor changes anything."""
    device = CrazyflieTwin(DeviceRequest(request("crazyflie", ["x"]), Faults()))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.connect(device.sockets()[0].getsockname())
            for port in Port:
                for channel in range(4):
                    for tail in (b"", b"\0", b"\2\xff", b"\x07\0\0"):
                        client.send(bytes((header(port, channel),)) + tail)
                        device.serve(device.sockets()[0], 0.0)
            assert device.drones[0].values == Wire().drone.values
    finally:
        device.close()


@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_any_packet_is_survived(port, channel, data):
    """What comes in is either understood or one of the errors that the link expects."""
    wire = Wire()
    try:
        wire.put(port, channel, data)
    except (struct.error, IndexError, ValueError):
        return
    wire.wait(0.02)
    assert np.isfinite(wire.position).all()


# ---------------------------------------------------------------------- parameters


def test_parameters():
    wire = Wire()
    key = number("kalman.initialX")
    assert wire.put(Port.PARAM, 1, key) == [(Port.PARAM, 1, key + b"\0" + struct.pack("<f", 0.0))]
    assert wire.put(Port.PARAM, 2, key, struct.pack("<f", 0.5)) == [(Port.PARAM, 2, key + struct.pack("<f", 0.5))]
    assert wire.drone.value("kalman.initialX") == 0.5
    assert wire.put(Port.PARAM, 1, key)[0][2][3:] == struct.pack("<f", 0.5)
    assert wire.put(Port.PARAM, 1, b"\xff\xff") == [(Port.PARAM, 1, b"\xff\xff" + bytes((LogStatus.UNKNOWN,)))]


def test_constants_are_not_answered():
    wire = Wire(device={"positioning": {"system": "loco"}})
    assert wire.drone.value("deck.bcLoco") == 1
    assert wire.put(Port.PARAM, 2, number("deck.bcLoco"), 0) == []
    assert wire.drone.value("deck.bcLoco") == 1


def test_stored_parameters():
    wire = Wire()
    key = number("ring.effect")
    (answer,) = wire.put(Port.PARAM, 3, int(Misc.EXTENDED_2), key)
    assert answer[2][3:] == b"\0\1"
    assert wire.put(Port.PARAM, 3, int(Misc.STORED), key)[0][2][3:] == b"\0\6"
    wire.put(Port.PARAM, 2, key, 2)
    wire.put(Port.PARAM, 3, int(Misc.STORE), key)
    wire.put(Port.PARAM, 2, key, 1)
    assert wire.put(Port.PARAM, 3, int(Misc.STORED), key)[0][2][3:] == b"\1\6\2"
    assert wire.put(Port.LINK, 3, NRF, int(PowerSwitch.OFF)) == [(Port.LINK, 3, bytes((NRF, PowerSwitch.OFF)))]
    assert wire.put(Port.PARAM, 1, key) == []
    wire.put(Port.LINK, 3, NRF, int(PowerSwitch.ON))
    assert wire.drone.value("ring.effect") == 2  # it survives a restart, which others do not
    wire.put(Port.PARAM, 3, int(Misc.CLEAR), key)
    assert wire.put(Port.PARAM, 3, int(Misc.STORED), key)[0][2][3:] == b"\0\6"
    assert wire.put(Port.PARAM, 3, int(Misc.DEFAULT_2), number("pm.lowVoltage"))[0][2][3:] == b"\0" + struct.pack(
        "<f", 3.2
    )


def test_parameter_by_name():
    wire = Wire()
    name = b"stabilizer\0controller\0"
    assert wire.put(Port.PARAM, 3, 0, name, 0x08, 2) == [(Port.PARAM, 3, b"\0" + name + b"\0")]
    assert wire.drone.value("stabilizer.controller") == 2
    assert wire.put(Port.PARAM, 3, 0, b"no\0such\0", 0x08, 2)[0][2][-1] == LogStatus.UNKNOWN


def test_every_parameter_packs():
    wire = Wire()
    for i, parameter in enumerate(PARAMETER_TABLE.variables):
        ((_, _, answer),) = wire.put(Port.PARAM, 1, struct.pack("<H", i))
        assert PACKINGS[parameter.type].unpack(answer[3:])[0] == pytest.approx(wire.drone.values[i])


# ---------------------------------------------------------------------- logs


def test_log_block():
    """Values, types, stamps in milliseconds, and the rate."""
    wire = Wire(start=[[1.5, -0.25, 0.0]])
    for name, value in (("kalman.initialX", 1.5), ("kalman.initialY", -0.25)):
        wire.put(Port.PARAM, 2, number(name), struct.pack("<f", value))
    wire.put(Port.PARAM, 2, number("kalman.resetEstimation"), 1)
    items = variable(0x77, "stateEstimate.x") + variable(0x55, "stateEstimateZ.y") + variable(0x88, "pm.vbat")
    assert wire.put(Port.LOG, 1, int(Log.CREATE), 3, items)[0][2] == bytes((Log.CREATE, 3, 0))
    assert wire.wait(0.1) == []
    assert wire.put(Port.LOG, 1, int(Log.START), 3, 2)[0][2] == bytes((Log.START, 3, 0))
    packets = wire.wait(1.0)
    assert len(packets) == 50
    assert {(port, channel, data[0]) for port, channel, data in packets} == {(Port.LOG, 2, 3)}
    stamps = [int.from_bytes(data[1:4], "little") for _, _, data in packets]
    assert set(np.diff(stamps)) <= {19, 20, 21}
    x, y, volts = struct.unpack("<fhe", packets[-1][2][4:])
    assert (x, y) == (1.5, -250)
    assert volts == pytest.approx(4.2, abs=0.01)
    wire.put(Port.LOG, 1, int(Log.STOP), 3)
    assert wire.wait(0.1) == []
    assert wire.put(Port.LOG, 1, int(Log.DELETE), 3)[0][2][2] == 0
    assert wire.put(Port.LOG, 1, int(Log.START), 3, 2)[0][2][2] == LogStatus.UNKNOWN


def test_log_limits():
    """26 bytes, 16 blocks, 128 variables; only errors that cflib knows."""
    wire = Wire()
    wide, narrow = variable(0x77, "stateEstimate.x"), variable(0x11, "pm.batteryLevel")
    assert wire.put(Port.LOG, 1, int(Log.CREATE), 0, wide * 6)[0][2][2] == LogStatus.OK
    assert wire.put(Port.LOG, 1, int(Log.APPEND), 0, wide)[0][2][2] == LogStatus.TOO_LARGE
    assert wire.put(Port.LOG, 1, int(Log.APPEND), 0, narrow * 2)[0][2][2] == LogStatus.OK
    assert wire.put(Port.LOG, 1, int(Log.CREATE), 0, wide)[0][2][2] == LogStatus.EXISTS
    assert wire.put(Port.LOG, 1, int(Log.CREATE), 1, b"\x11\xff\xff")[0][2][2] == LogStatus.UNKNOWN
    wire.put(Port.LOG, 1, int(Log.RESET))
    for block in range(16):
        assert wire.put(Port.LOG, 1, int(Log.CREATE), block, narrow * 8)[0][2][2] == LogStatus.OK
    assert wire.put(Port.LOG, 1, int(Log.APPEND), 0, narrow)[0][2][2] == LogStatus.NO_ROOM
    assert wire.put(Port.LOG, 1, int(Log.CREATE), 16, narrow)[0][2][2] == LogStatus.NO_ROOM
    assert wire.put(Port.LOG, 1, 99, 0)[0][2][2] == LogStatus.NO_COMMAND
    assert wire.put(Port.LOG, 1, int(Log.RESET))[0][2] == bytes((Log.RESET, 0, 0))  # three bytes, or cflib stumbles


def test_silence_deletes_log_blocks():
    """After a second without a link the firmware forgets them; the client is not told."""
    with Client(silent_from_s=1.0, silent_for_s=1.5) as client:
        block = variable(0x77, "stateEstimate.x")
        client.device.drones[0].logs.execute(Log.CREATE, 0, block, 0.0)
        client.device.drones[0].logs.execute(Log.START, 0, b"\1", 0.0)
        client.ping(0.0)
        for t, logged in ((0.5, True), (1.9, False), (2.1, False), (2.6, False)):
            client.heard()
            client.device.advance(t)
            assert bool(client.heard()) == logged
        assert client.device.drones[0].logs.execute(Log.START, 0, b"\1", 2.6) == LogStatus.UNKNOWN


def test_other_memories():
    """What Bitcraze's examples read: EEPROM with its checksum, an empty list of decks, errors of the tester."""
    wire = Wire()

    def read(kind, count):
        return wire.put(Port.MEMORY, 1, struct.pack("<BI", Memories.kinds.index(kind), 0), count)[0][2][6:]

    eeprom = read(MemoryKind.EEPROM, 21)
    assert eeprom[:7] == b"0xBC\1P\2"
    assert sum(eeprom[:20]) % 256 == eeprom[20]
    assert read(MemoryKind.DECKS, 24) == b"\3" + bytes(23)
    tester = Memories.kinds.index(MemoryKind.TESTER)
    wire.put(Port.MEMORY, 2, struct.pack("<BI", tester, 5), bytes((5, 6, 7, 99)))
    assert wire.flock.decks.memories[0].write_errors == 1
    wire.put(Port.PARAM, 2, number("memTst.resetW"), 1)
    assert wire.flock.decks.memories[0].write_errors == 0


@pytest.mark.slow
def test_power_switch():
    """Off it answers no scan of its own, falls, and forgets what is not stored; on it is as new."""
    wire = Wire().hovering()
    wire.put(Port.LINK, 3, NRF, int(PowerSwitch.OFF))
    wire.wait(1.0)
    assert wire.position[2] == 0.0
    assert wire.put(Port.LINK, 0, b"echo") == []
    wire.flock.supervisor.tumbled[0] = False
    assert wire.put(Port.LINK, 3, NRF, int(PowerSwitch.RESET_BEGIN))[0][2] == b"\xfe\xff\xe7\xe7\xe7\xe7"
    wire.put(Port.LINK, 3, NRF, int(PowerSwitch.ON))
    assert wire.put(Port.LINK, 0, b"echo") == [(Port.LINK, 0, b"echo")]
    wire.hovering(0.5)


@pytest.mark.slow
def test_every_variable_packs():
    """In the type that it has on board, standing and flying."""
    wire = Wire(device={"multiranger": True}).hovering()
    for i, one in enumerate(LOG_TABLE.variables):
        wire.put(Port.LOG, 1, int(Log.RESET))
        wire.put(Port.LOG, 1, int(Log.CREATE), 0, struct.pack("<BH", LOG_CODES[one.type], i))
        wire.put(Port.LOG, 1, int(Log.START), 0, 1)
        ((_, _, data),) = wire.wait(0.02)[:1]
        (value,) = PACKINGS[one.type].unpack(data[4:])
        assert math.isfinite(value)


# ---------------------------------------------------------------------- memories


def test_memories_are_listed():
    wire = Wire()
    assert wire.put(Port.MEMORY, 0, 1)[0][2] == bytes((1, len(Memories.kinds) + 1))  # and the one of its Flow deck
    assert wire.put(Port.MEMORY, 0, 2, len(Memories.kinds))[0][2][2] == MemoryKind.DECK
    assert wire.put(Port.MEMORY, 0, 2, len(Memories.kinds) + 1) == []
    kinds = [wire.put(Port.MEMORY, 0, 2, i)[0][2][2] for i in range(len(Memories.kinds))]
    assert kinds == list(Memories.kinds)


def test_lighthouse_memory():
    """Four base stations; a change of the version erases them."""
    wire = Wire(device={"positioning": {"system": "lighthouse"}})
    memory = Memories.kinds.index(MemoryKind.LIGHTHOUSE)
    assert wire.flock.decks.station_status(0) == 1
    for begin, size in ((0, 49), (CALIBRATION, 61)):
        page = bytes(range(size - 1)) + b"\1"
        for at in range(0, size, 24):
            where = struct.pack("<BI", memory, begin + 0x100 + at)
            assert wire.put(Port.MEMORY, 2, where, page[at : at + 24])[0][2] == where + b"\0"
    assert wire.flock.decks.memories[0].geometries == wire.flock.decks.memories[0].calibrations == 0b10
    assert wire.flock.decks.station_status(0) == 2
    beyond = struct.pack("<BI", memory, 0x400)
    assert wire.put(Port.MEMORY, 2, beyond, b"\1")[0][2][-1] == LogStatus.IO
    assert wire.put(Port.MEMORY, 1, beyond, 4)[0][2] == beyond + bytes((LogStatus.IO,))
    assert wire.put(Port.LOCATION, 1, 11, struct.pack("<HH", 2, 2)) == [(Port.LOCATION, 1, b"\x0b\1")]
    assert wire.flock.decks.memories[0].stored == (2, 2)
    wire.put(Port.PARAM, 2, number("lighthouse.systemType"), 1)
    assert wire.flock.decks.memories[0].geometries == 0


def test_loco_anchors():
    """They say where they are once they have been told; four are enough for an estimate."""
    wire = Wire(device={"positioning": {"system": "loco"}})
    memory = Memories.kinds.index(MemoryKind.LOCO)
    for anchor in range(4):
        assert not wire.flock.decks.ready()[0]
        assert wire.put(Port.LOCATION, 1, 2, anchor, 1, struct.pack("<fff", anchor, 1.0, 2.0)) == []
    assert wire.flock.decks.ready()[0]
    where = struct.pack("<BI", memory, ANCHOR_PAGES + 0x300)
    ((_, _, answer),) = wire.put(Port.MEMORY, 1, where, 13)
    assert struct.unpack("<fff?", answer[6:]) == (3.0, 1.0, 2.0, True)
    assert wire.put(Port.MEMORY, 2, where, b"\0")[0][2][-1] == LogStatus.IO  # written by radio only


# ---------------------------------------------------------------------- the link


class Client:
    """One socket, and a device that is served by hand in virtual time."""

    def __init__(self, **faults):
        self.device = CrazyflieTwin(DeviceRequest(request("crazyflie", ["x"]), Faults(**faults)))
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(self.device.sockets()[0].getsockname())
        self.socket.setblocking(False)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()
        self.device.close()

    def ping(self, t, tag=b"x"):
        self.socket.send(bytes((header(Port.LINK, 0),)) + tag)
        self.device.serve(self.device.sockets()[0], t)

    def heard(self):
        packets = []
        while True:
            try:
                packets.append(self.socket.recv(64))
            except BlockingIOError:
                return packets


def test_scan_and_address():
    """The probe that cflib's scan sends is answered, at the address that the device gives."""
    with Client() as client:
        assert client.device.addresses == (f"udp://127.0.0.1:{client.socket.getpeername()[1]}",)
        client.socket.send(b"\xff")
        client.device.serve(client.device.sockets()[0], 0.0)
        assert len(client.heard()) == 1


def test_loss():
    """Each way on its own: of 1000 pings at 20 % come back 64 %."""
    with Client(loss=0.2) as client:
        back = 0
        for i in range(1000):
            client.ping(0.001 * i)
            back += len(client.heard())
    assert back == pytest.approx(640, abs=50)


def test_silence():
    with Client(silent_from_s=1.0, silent_for_s=2.0) as client:
        counts = []
        for t in (0.5, 1.5, 2.9, 3.1):
            client.ping(t)
            counts.append(len(client.heard()))
    assert counts == [1, 0, 0, 1]


def test_delay():
    """What is sent waits, and keeps its order."""
    with Client(delay_s=0.05) as client:
        client.ping(0.001, b"1")
        client.ping(0.002, b"2")
        client.device.advance(0.05)
        assert client.heard() == []
        client.device.advance(0.06)
        assert [packet[1:] for packet in client.heard()] == [b"1", b"2"]


def test_the_newest_client_is_served():
    with Client() as client, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        client.ping(0.0)
        assert len(client.heard()) == 1
        other.connect(client.socket.getpeername())
        other.setblocking(False)
        other.send(bytes((header(Port.LINK, 0),)) + b"y")
        client.device.serve(client.device.sockets()[0], 0.1)
        assert other.recv(64)[1:] == b"y"
        assert client.heard() == []


def test_truth_and_lock_on_the_console():
    with Client() as client:
        client.ping(0.0)
        client.device.flock.supervisor.stop(0)
        client.device.advance(0.01)
        said = b"".join(packet[1:] for packet in client.heard() if packet[0] >> 4 == Port.CONSOLE)
        assert b"Locked" in said
        position, yaw = client.device.truth()
        assert (position.shape, yaw.shape) == ((1, 3), (1,))


def test_nature_is_that_of_the_other_twin():
    """Wobble and noise come out of the same models, with the same seeds, as in the robot's own process."""
    nature = Disturbance(hover_jitter=Jitter(0.05), position_sigma=0.01, latency_s=0.1, wind=(0.5, 0.0))
    asked = request("crazyflie", ["x"], disturbance=nature)
    flock, plain = Flock(asked, Faults()), TwinBody(asked)
    plain.takeoff([0], [0.5])
    flock.planner.climb(0, 0.0, np.zeros(4), height=0.5, yaw=0.0, span=1.25, landing=False)
    noise = []
    for tick in range(1, 401):
        flock.advance(0.01 * tick)
        (state,) = plain.read(0.01 * tick)
        noise.append(flock.estimate[0] - flock.place[0])
    assert flock.place[0, :2] == pytest.approx(state.true_position[:2], abs=1e-3)
    assert np.ptp([flock.place[0, 0], 0.0]) > 1e-3
    assert np.std(noise) == pytest.approx(0.01, rel=0.1)


def test_other_robots_and_wrong_settings():
    with pytest.raises(BodyError, match="is no twin of a tello"):
        CrazyflieTwin(DeviceRequest(request("tello", ["x"]), Faults()))
    with pytest.raises(BodyError, match="contrl"):
        CrazyflieTwin(DeviceRequest(request("crazyflie", ["x"], device={"contrl": 1}), Faults()))
