"""What a Crazyflie twin answers: tables, parameters, logs, memories, and what a bad link does to that."""

import math
import socket
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from agents.body.interface import BodyError, Disturbance, Jitter
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crazyradio import ACK, QUEUE
from bridges.crazyflie.protocol.crtp import (
    NRF,
    Log,
    LogStatus,
    MemoryKind,
    Misc,
    Port,
    PowerSwitch,
    SupervisorCommand,
    Toc,
)
from bridges.crazyflie.protocol.tables import EXTENDED, LOG_CODES, PACKINGS, READ_ONLY, inventory, pack
from bridges.crazyflie.twin.device import CrazyflieTwin
from bridges.crazyflie.twin.memory import ANCHOR_PAGES, CALIBRATION, Memories
from bridges.crazyflie.twin.radio import NOTHING, RadioLink
from bridges.crazyflie.twin.vehicle import Vehicle
from tests.bridges.crazyflie.wire import Wire
from tests.requests import request
from twins.body import TwinBody
from twins.device import DeviceRequest, Faults

PARAMETER_TABLE, LOG_TABLE = inventory().parameters, inventory().logs


def variable(kind, name):
    return struct.pack("<BH", kind, LOG_TABLE.number[name])


def logged(wire, *names):
    """Values of log variables, in the type that they have on board."""
    values = []
    for name in names:
        kind = wire.drone.log_table.variables[LOG_TABLE.number[name]].type
        wire.put(Port.LOG, 1, Log.RESET)
        wire.log(Log.CREATE, 0, variable(LOG_CODES[kind], name))
        wire.log(Log.START, 0, 1)
        values.append(PACKINGS[kind].unpack(wire.wait(0.01)[0][2][4:])[0])
    return values


def at(kind, address):
    return struct.pack("<BI", Memories.kinds.index(kind), address)


def test_greeting_version_and_tables():
    wire = Wire()
    assert wire.ask(Port.LINK, 1, 0) == b"Bitcraze Crazyflie".ljust(30, b"\0")
    assert wire.ask(Port.PLATFORM, 1, 0) == b"\0" + struct.pack("<I", 12)
    assert wire.ask(Port.LINK, 0, b"anything") == b"anything"
    assert wire.ask(Port.SUPERVISOR, 0, SupervisorCommand.ASK)[0] == 0x8C
    assert wire.ask(Port.SUPERVISOR, 1, SupervisorCommand.RECOVER) == b"\x82\1\1"
    for port, table in ((Port.PARAM, PARAMETER_TABLE), (Port.LOG, LOG_TABLE)):
        assert struct.unpack("<BHI", wire.ask(port, 0, Toc.INFO)[:7]) == (Toc.INFO, len(table.items), table.crc)
        for i, name in enumerate(table.number):
            item = wire.ask(port, 0, Toc.ITEM, struct.pack("<H", i))
            assert len(item) <= crtp.MTU
            assert item[4:] == name.replace(".", "\0").encode() + b"\0"
    for i, parameter in enumerate(PARAMETER_TABLE.variables):
        answer = wire.ask(Port.PARAM, 1, struct.pack("<H", i))
        assert PACKINGS[parameter.type].unpack(answer[3:])[0] == pytest.approx(wire.drone.values[i])
    assert PARAMETER_TABLE.crc != LOG_TABLE.crc  # cflib keeps both in one cache


def test_parameters():
    wire = Wire(device={"positioning": {"system": "loco"}})
    key, value = wire.key("kalman.initialX"), wire.drone.value
    assert wire.ask(Port.PARAM, 1, key) == key + b"\0" + struct.pack("<f", 0.0)
    assert wire.set("kalman.initialX", "f", 0.5) == [(Port.PARAM, 2, key + struct.pack("<f", 0.5))]
    assert (value("kalman.initialX"), wire.ask(Port.PARAM, 1, key)[3:]) == (0.5, struct.pack("<f", 0.5))
    assert wire.ask(Port.PARAM, 1, b"\xff\xff") == b"\xff\xff" + bytes((LogStatus.UNKNOWN,))
    assert (wire.set("deck.bcLoco", "B", 0), value("deck.bcLoco")) == ([], 1)  # a constant
    name = b"stabilizer\0controller\0"
    assert (wire.ask(Port.PARAM, 3, 0, name, 0x08, 2), value("stabilizer.controller")) == (b"\0" + name + b"\0", 2)
    assert wire.ask(Port.PARAM, 3, 0, b"no\0such\0", 0x08, 2)[-1] == LogStatus.UNKNOWN


def test_stored_parameters():
    wire = Wire()
    key = wire.key("ring.effect")

    def asked(command, name="ring.effect"):
        return wire.ask(Port.PARAM, 3, command, wire.key(name))[3:]

    assert asked(Misc.EXTENDED_2) == b"\0\1"
    assert asked(Misc.STORED) == b"\0\6"
    wire.set("ring.effect", "B", 2)
    asked(Misc.STORE)
    wire.set("ring.effect", "B", 1)
    assert asked(Misc.STORED) == b"\1\6\2"
    assert wire.ask(Port.LINK, 3, NRF, PowerSwitch.OFF) == bytes((NRF, PowerSwitch.OFF))
    assert wire.put(Port.PARAM, 1, key) == []
    wire.put(Port.LINK, 3, NRF, PowerSwitch.ON)
    assert wire.drone.value("ring.effect") == 2  # it survives a restart, which others do not
    asked(Misc.CLEAR)
    assert asked(Misc.STORED) == b"\0\6"
    assert asked(Misc.DEFAULT_2, "pm.lowVoltage") == b"\0" + struct.pack("<f", 3.2)


def test_log_block():
    wire = Wire(start=[[1.5, -0.25, 0.0]])
    for name, packing, value in (("initialX", "f", 1.5), ("initialY", "f", -0.25), ("resetEstimation", "B", 1)):
        wire.set(f"kalman.{name}", packing, value)
    items = variable(0x77, "stateEstimate.x") + variable(0x55, "stateEstimateZ.y") + variable(0x88, "pm.vbat")
    assert wire.ask(Port.LOG, 1, Log.CREATE, 3, items) == bytes((Log.CREATE, 3, 0))
    assert wire.wait(0.1) == []
    assert wire.ask(Port.LOG, 1, Log.START, 3, 2) == bytes((Log.START, 3, 0))
    packets = wire.wait(1.0)
    assert len(packets) == 50
    assert {(port, channel, data[0]) for port, channel, data in packets} == {(Port.LOG, 2, 3)}
    stamps = [int.from_bytes(data[1:4], "little") for _, _, data in packets]
    assert set(np.diff(stamps)) <= {19, 20, 21}
    assert struct.unpack("<fhe", packets[-1][2][4:]) == (1.5, -250, pytest.approx(4.2, abs=0.01))
    wire.put(Port.LOG, 1, Log.STOP, 3)
    assert wire.wait(0.1) == []
    assert [wire.log(Log.DELETE, 3), wire.log(Log.START, 3, 2)] == [LogStatus.OK, LogStatus.UNKNOWN]


def test_log_limits():
    wire = Wire()
    wide, narrow = variable(0x77, "stateEstimate.x"), variable(0x11, "pm.batteryLevel")
    for command, block, items, status in (
        (Log.CREATE, 0, wide * 6, LogStatus.OK),
        (Log.APPEND, 0, wide, LogStatus.TOO_LARGE),
        (Log.APPEND, 0, narrow * 2, LogStatus.OK),
        (Log.CREATE, 0, wide, LogStatus.EXISTS),
        (Log.CREATE, 1, b"\x11\xff\xff", LogStatus.UNKNOWN),
        (99, 0, b"", LogStatus.NO_COMMAND),
    ):
        assert (items, wire.log(command, block, items)) == (items, status)
    assert wire.ask(Port.LOG, 1, Log.RESET) == bytes((Log.RESET, 0, 0))  # three bytes, or cflib stumbles
    assert {wire.log(Log.CREATE, block, narrow * 8) for block in range(16)} == {LogStatus.OK}
    assert [wire.log(Log.APPEND, 0, narrow), wire.log(Log.CREATE, 16, narrow)] == [LogStatus.NO_ROOM] * 2


def test_memories_are_listed():
    wire, count = Wire(), len(Memories.kinds)
    assert wire.ask(Port.MEMORY, 0, 1) == bytes((1, count + 1))  # and the one of its Flow deck
    assert [wire.ask(Port.MEMORY, 0, 2, i)[2] for i in range(count + 1)] == [*Memories.kinds, MemoryKind.DECK]
    assert wire.put(Port.MEMORY, 0, 2, count + 1) == []
    eeprom = wire.ask(Port.MEMORY, 1, at(MemoryKind.EEPROM, 0), 21)[6:]
    assert (eeprom[:7], sum(eeprom[:20]) % 256) == (b"0xBC\1P\2", eeprom[20])
    wire.put(Port.MEMORY, 2, at(MemoryKind.TESTER, 5), bytes((5, 6, 7, 99)))
    memories, errors = wire.vehicle.decks.memories, []
    for reset in (None, 0, 1):
        if reset is not None:
            wire.set("memTst.resetW", "B", reset)
        errors.append(memories.write_errors)
    assert errors == [1, 1, 0]
    assert Wire(external=True).ask(Port.MEMORY, 0, 1) == bytes((1, count))  # without a deck


def test_lighthouse_memory():
    wire = Wire(device={"positioning": {"system": "lighthouse"}})
    decks, memory = wire.vehicle.decks, wire.vehicle.decks.memories
    assert decks.station_status == 1
    for begin, size in ((0, 49), (CALIBRATION, 61)):
        page = bytes(range(size - 1)) + b"\1"
        for offset in range(0, size, 24):
            where = at(MemoryKind.LIGHTHOUSE, begin + 0x100 + offset)
            assert wire.ask(Port.MEMORY, 2, where, page[offset : offset + 24]) == where + b"\0"
    assert (memory.geometries, memory.calibrations, decks.station_status) == (0b10, 0b10, 2)
    beyond = at(MemoryKind.LIGHTHOUSE, 0x400)
    assert wire.ask(Port.MEMORY, 2, beyond, b"\1")[-1] == LogStatus.IO
    assert wire.ask(Port.MEMORY, 1, beyond, 4) == beyond + bytes((LogStatus.IO,))
    assert (wire.ask(Port.LOCATION, 1, 11, struct.pack("<HH", 2, 2)), memory.stored) == (b"\x0b\1", (2, 2))
    wire.set("lighthouse.systemType", "B", 1)
    assert memory.geometries == 0


def test_loco_anchors():
    wire = Wire(device={"positioning": {"system": "loco"}})
    for anchor in range(4):
        assert not wire.vehicle.decks.ready
        assert wire.put(Port.LOCATION, 1, 2, anchor, 1, struct.pack("<fff", anchor, 1.0, 2.0)) == []
    assert wire.vehicle.decks.ready
    where = at(MemoryKind.LOCO, ANCHOR_PAGES + 0x300)
    assert struct.unpack("<fff?", wire.ask(Port.MEMORY, 1, where, 13)[6:]) == (3.0, 1.0, 2.0, True)
    assert wire.ask(Port.MEMORY, 2, where, b"\0")[-1] == LogStatus.IO  # written by radio only


class Client:
    """One socket, and a device that is served by hand in virtual time."""

    def __init__(self, **faults):
        self.device = CrazyflieTwin(DeviceRequest(request("crazyflie", ["x"]), Faults(**faults)))
        self.socket = self.connected()

    def close(self):
        self.socket.close()
        self.device.close()

    def connected(self):
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(self.device.sockets()[0].getsockname())
        made.setblocking(False)
        return made

    def send(self, packet, t=0.0, by=None):
        (by or self.socket).send(packet)
        self.device.serve(self.device.sockets()[0], t)

    def ping(self, t, tag=b"x", by=None):
        self.send(bytes((crtp.header(Port.LINK, 0),)) + tag, t, by)

    def heard(self, at=None):
        packets = []
        while True:
            try:
                packets.append((at or self.socket).recv(64))
            except BlockingIOError:
                return packets


def test_malformed_packets_are_dropped():
    with closing(Client()) as client:
        assert client.device.addresses == (f"udp://127.0.0.1:{client.socket.getpeername()[1]}",)
        client.send(b"\xff")
        assert len(client.heard()) == 1
        for port in Port:
            for channel in range(4):
                for tail in (b"", b"\0", b"\2\xff", b"\x07\0\0"):
                    client.send(bytes((crtp.header(port, channel),)) + tail)
        assert client.device.drones[0].values == Wire().drone.values
    with pytest.raises(BodyError, match="contrl"):
        CrazyflieTwin(DeviceRequest(request("crazyflie", ["x"], device={"contrl": 1}), Faults()))


def test_loss_and_delay():
    with closing(Client(delay_s=0.05)) as client:
        client.ping(0.001, b"1")
        client.ping(0.002, b"2")
        client.device.advance(0.05)
        assert client.heard() == []
        client.device.advance(0.06)
        assert [packet[1:] for packet in client.heard()] == [b"1", b"2"]
    with closing(Client(loss=0.2)) as client:
        for i in range(200):
            client.ping(0.001 * i)
        assert len(client.heard()) == pytest.approx(200 * 0.8**2, abs=25)


def test_silence():
    with closing(Client(silent_from_s=1.0, silent_for_s=1.5)) as client:
        logs = client.device.drones[0].logs
        logs.execute(Log.CREATE, 0, variable(0x77, "stateEstimate.x"), 0.0)
        logs.execute(Log.START, 0, b"\1", 0.0)
        client.ping(0.0)
        for t, logged in ((0.5, True), (1.9, False), (2.1, False), (2.6, False)):
            client.heard()
            client.device.advance(t)
            assert bool(client.heard()) == logged
        assert logs.execute(Log.START, 0, b"\1", 2.6) == LogStatus.UNKNOWN
        for t, answers in ((2.4, 0), (2.6, 1)):
            client.ping(t)
            assert len(client.heard()) == answers


def test_newest_client_is_served_and_told_of_locks():
    with closing(Client()) as client, client.connected() as other:
        client.ping(0.0, b"y", by=other)
        client.ping(0.1)
        assert ([packet[1:] for packet in client.heard(other)], len(client.heard())) == ([b"y"], 1)
        client.device.drones[0].vehicle.supervisor.stop()
        client.device.advance(0.2)
        assert b"Locked" in b"".join(packet[1:] for packet in client.heard() if packet[0] >> 4 == Port.CONSOLE)
        assert client.heard(other) == []
        assert [each.shape for each in client.device.truth()] == [(1, 3), (1,)]


def test_nature_is_that_of_the_other_twin():
    """Wobble and noise come out of the same models, with the same seeds, as in the robot's own process."""
    nature = Disturbance(hover_jitter=Jitter(0.05), position_sigma=0.01, latency_s=0.1, wind=(0.5, 0.0))
    asked = request("crazyflie", ["x"], disturbance=nature)
    vehicle, plain = Vehicle(asked, Faults(), 0), TwinBody(asked)
    plain.takeoff([0], [0.5])
    vehicle.planner.climb(0.0, np.zeros(4), height=0.5, yaw=0.0, span=1.25, landing=False)
    noise = []
    for tick in range(1, 401):
        vehicle.advance(0.01 * tick)
        (state,) = plain.read(0.01 * tick)
        noise.append(np.subtract(vehicle.estimate, vehicle.place))
    assert vehicle.place[:2] == pytest.approx(state.true_position[:2], abs=1e-3)
    assert abs(vehicle.place[0]) > 1e-3
    assert np.std(noise) == pytest.approx(0.01, rel=0.1)


REQUEST = b"\xff\x05\x01"


class Host:
    """The counters of a client, as cflib keeps them, over exchanges of which the given ones lose their answer."""

    def __init__(self, link):
        self.link, self.up, self.down = link, 0, 0

    def poll(self, packet=b"\xff", *, answered=True):
        """Answer of the drone, or None if it was lost; and the packet that the drone was given."""
        first = packet[0] & 0xF3 | self.up << 3 | self.down << 2
        status, answer, forwarded = self.link.exchange(bytes((first,)) + packet[1:], 3)
        assert status & ACK
        if not answered:
            return None, forwarded
        if (answer[0] & 4) == self.down << 2:
            self.down = 1 - self.down
        self.up = 1 - self.up
        return answer, forwarded


@pytest.fixture
def radio():
    return RadioLink(np.random.default_rng(1), Faults(), 0)


def secured(radio):
    assert radio.exchange(REQUEST, 3)[1] == REQUEST
    return Host(radio)


def test_safelink_loses_and_repeats_nothing(radio):
    host = secured(radio)
    for number in range(20):
        radio.send(Port.LOG, 2, bytes((number,)))
    up, down, sent = [], [], 0
    for attempt in range(60):
        answer, forwarded = host.poll(bytes((0x7C, sent)), answered=attempt % 3 != 0)
        up += [] if forwarded is None else [forwarded[1]]
        sent += answer is not None
        if answer is not None and answer[1:] != NOTHING[1:] and answer[1] not in down:
            down.append(answer[1])
    assert (up, down) == (list(range(max(up) + 1)), list(range(20)))


def test_a_client_without_safelink_is_heard_once(radio):
    """A drone that still has safelink on drops every packet of a client that has it off as a repetition."""
    secured(radio)
    given = [radio.exchange(bytes((0x7C, number)), 3)[2] for number in range(5)]
    assert sum(packet is not None for packet in given) <= 1
    assert radio.safelink, "it outlives the session"


def test_answers_wait_behind_logs(radio):
    host = secured(radio)
    for number in range(QUEUE + 30):
        radio.send(Port.LOG, 2, bytes((number % 256,)))
    radio.send(Port.HIGH_LEVEL, 0, b"answer")
    assert radio.dropped == 30
    answers = [host.poll()[0][1:] for _ in range(QUEUE + 1)]
    assert answers.index(b"answer") == QUEUE


def test_an_outage_empties_the_queue_and_ends(radio):
    secured(radio)
    radio.silence(1.5)
    radio.send(Port.LOG, 2, b"\0")
    for t, waiting, answered in ((0.9, 1, False), (1.1, 0, False), (1.6, 0, True)):
        radio.t = t
        radio.send_due()
        assert len(radio.queue) == waiting
        assert bool(radio.exchange(REQUEST, 3)[0] & ACK) == answered


def test_losses_cost_retransmissions():
    radio = RadioLink(np.random.default_rng(1), Faults(loss=0.5), 0)
    results = [radio.exchange(bytes((0x7C, number % 256)), 3) for number in range(2000)]
    share = np.mean([bool(status & ACK) for status, _, _ in results])
    assert share == pytest.approx(1.0 - 0.75**4, abs=0.05)
    assert sum(packet is not None for _, _, packet in results) == pytest.approx(2000 * (1.0 - 0.5**4), rel=0.05)


def test_size_of_the_firmware_and_its_numbers():
    tables = inventory()
    assert (len(tables.parameters.variables), len(tables.logs.variables)) == (402, 637)
    assert sum(bool(variable.flags & EXTENDED) for variable in tables.parameters.variables) == 146
    assert pack("u8", 257.9) == b"\1"
    assert pack("i16", -1.0) == b"\xff\xff"
    assert pack("half", 1e9) == PACKINGS["half"].pack(math.inf)


def test_values_of_a_drone_that_stands():
    wire = Wire()
    assert wire.drone.value("system.selftestPassed") == 1
    assert wire.drone.value("deck.bcFlow2") == 1  # without another system of positioning it has a Flow deck
    assert wire.drone.value("pid_rate.roll_kp") == 250.0
    assert logged(wire, "stabilizer.roll", "stabilizer.pitch", "stateEstimate.yaw") == pytest.approx([0.4, -0.3, 0.0])
    assert logged(wire, "acc.x", "acc.y", "acc.z") == pytest.approx([0.0, 0.0, 1.0], abs=0.03)
    assert logged(wire, "supervisor.accNorm") == pytest.approx([1.0])
    assert logged(wire, "motor.m1", "range.front", "stabilizer.thrust") == [0, 0, 0.0]  # it has no Multi-ranger
    assert 0.0 < logged(wire, "gyro.xVariance")[0] < 0.1


@pytest.mark.slow
def test_values_of_a_drone_that_flies():
    wire = Wire(device={"multiranger": True}).streaming()
    wire.wait(0.1, lambda: wire.goal(1.0, 0.0, 1.0))
    roll, pitch, qx, qy, qw = logged(wire, *(f"stateEstimate.{name}" for name in ("roll", "pitch", "qx", "qy", "qw")))
    assert (pitch < -5.0, abs(roll) < 1.0) == (True, True)
    assert (qx, qy, qw) == pytest.approx((0.0, math.sin(math.radians(-0.5 * pitch)), 1.0), abs=0.02)
    assert logged(wire, "motor.m1")[0] == pytest.approx(39300.0, rel=0.01)
    assert np.isfinite(logged(wire, *LOG_TABLE.number)).all()


PARAMETERS = """{"deck": {"bcFlow2": {"__class__": "ParamTocElement", "ident": 0, "group": "deck", "name": "bcFlow2",
                              "ctype": "uint8_t", "pytype": "", "access": 1, "extended": false}}}"""
ENTRY = """{"pm": {"vbat": {"__class__": "LogTocElement", "ident": %d, "group": "pm", "name": "vbat",
                        "ctype": "%s", "pytype": "<f", "access": 0}}}"""


def test_tables_of_files_are_read_or_refused(tmp_path):
    def read(*texts):
        files = [str(tmp_path / f"table{hash(text)}.json") for text in texts]
        for file, text in zip(files, texts, strict=True):
            Path(file).write_text(text)
        return inventory(tuple(files))

    tables = read(ENTRY % (0, "float"), PARAMETERS)
    (log,), (parameter,) = tables.logs.variables, tables.parameters.variables
    assert (log.name, log.type, parameter.name, parameter.flags) == ("pm.vbat", "float", "deck.bcFlow2", READ_ONLY)
    for texts, said in (
        ([ENTRY % (0, "float")] * 2, "second table"),
        ([""], "no table of a Crazyflie"),
        (["[]"], "no table of a Crazyflie"),
        (['{"pm": {"vbat": {"ident": 0}}}'], "no table of a Crazyflie"),
        ([ENTRY % (3, "float")], "0, 1, 2"),
        ([ENTRY % (0, "float128")], "unknown type float128"),
    ):
        with pytest.raises(BodyError, match=said):
            read(*texts)
