"""Connection to one Crazyflie through cflib, with the deadlines and the supervision that cflib lacks.

Over a radio cflib gives a link up after 100 unanswered polls, 0.3 s with one drone. Here the link stays and its polls
go on; `Link.gap` tells how long nothing was answered. Parameters are read one by one when they are needed: reading all
of them takes longer than a Crazyflie flies without setpoints.
"""

from __future__ import annotations

import logging
import re
import struct
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

from agents.body.interface import BodyError
from agents.clock import uptime
from agents.user_folder import cache_folder
from bridges.crazyflie.dongle import plug_in
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.addresses import dongle_of
from bridges.crazyflie.protocol.crazyradio import software
from bridges.crazyflie.protocol.crtp import HighLevel, MemoryKind, Port
from bridges.crazyflie.trajectory import PLACES, PromptRadio, TrajectoryMemory

FIRST_S: Final = 0.6  # time to the first packet; cflib never repeats its first two requests
SILENCE_S: Final = 1.0  # time between two answers while the connection is set up
ANSWER_S: Final = 3.0  # time to the answer about a parameter
REPEAT_S: Final = 0.3  # a question about a parameter is repeated after this
BUSY_S: Final = 0.1  # no packet is handed to a radio that has been silent for longer: it would be sent after the gap
POLLS: Final = 1_000_000  # unanswered ones before cflib gives a link up: never before `Link.gap` has shown it
JOIN_S: Final = 1.5  # cflib's threads check for their end once per second
OLDEST: Final = (0, 1, 32)  # version of cflib that has all that is called: the emergency stop, for one
PERIODS_MS: Final = 10.0  # log periods are multiples of this

LONGEST_PERIOD: Final = 20  # longest period of a log block, in units of 10 ms

LogCallback = Callable[[float, int, Mapping[str, float]], None]


class Packet(Protocol):
    """The part of cflib's packet that is used."""

    port: int
    channel: int
    data: bytes


class LinkError(RuntimeError):
    """Connection failed or lost."""


class SilentError(LinkError):
    """No answer from the drone."""


def prepare(addresses: Sequence[str]) -> None:
    """Load cflib and its drivers, once per process, and plug in the software radios that the addresses name.

    Raises BodyError if cflib is not installed, or too old, or one radio is to be in several simulated airs.
    """
    remedy = "pip install -e '.[crazyflie]'"
    try:
        import cflib.crtp.radiodriver  # noqa: PLC0415 - an optional extra, under another licence
    except ModuleNotFoundError:
        raise BodyError(f"Crazyflies need cflib (GPL-3.0), which is an extra: {remedy}") from None
    installed = version("cflib")
    if tuple(int(part) for part in re.findall(r"\d+", installed)[: len(OLDEST)]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise BodyError(f"cflib {installed} is too old, Crazyflies need {oldest}: {remedy}")
    if not cflib.crtp.CLASSES:  # a second call would register every driver twice
        cflib.crtp.init_drivers()
    cflib.crtp.radiodriver.set_retries_before_disconnect(POLLS)
    airs = {(dongle_of(address), air) for address in addresses if (air := software(address)) is not None}
    if len(dict(airs)) < len(airs):
        raise BodyError(
            "one radio cannot reach drones of several twins: give each twin's robots a process of their own"
        )
    if airs:
        plug_in({int(number): air for number, air in airs})
    logging.getLogger("cflib").setLevel(logging.CRITICAL)  # cflib logs tracebacks of errors that are reported here


def cache() -> Path:
    """Folder for the firmwares' tables of contents: with a cached one, connecting is ten times as fast."""
    folder = cache_folder() / "crazyflie"
    folder.mkdir(parents=True, exist_ok=True)  # else several that connect at once fail in cflib, which creates it too
    return folder


def _tables() -> Any:  # noqa: ANN401 - cflib's
    """Cache of tables of contents: files, and one copy in memory for all drones of the process."""
    from cflib.crazyflie.toccache import TocCache  # noqa: PLC0415

    class Tables(TocCache):  # type: ignore[misc]
        known: ClassVar[dict[int, Any]] = KNOWN_TABLES

        def fetch(self, crc: int) -> Any:  # noqa: ANN401
            if crc not in self.known and (table := super().fetch(crc)):
                self.known[crc] = _plain(table)
            return self.known.get(crc)

        def insert(self, crc: int, toc: Any) -> None:  # noqa: ANN401
            super().insert(crc, toc)
            self.known[crc] = _plain(toc)

    return Tables(rw_cache=str(cache()))


KNOWN_TABLES: dict[int, Any] = {}


def _plain(table: Any) -> Any:  # noqa: ANN401 - cflib's
    """Mark no entry as extended: cflib asks for the kind of each at every connection, and nothing here uses it."""
    for group in table.values():
        for element in group.values():
            element.extended = False
    return table


class CrazyflieLink:
    """Connection to one Crazyflie; `prepare` must have been called."""

    def __init__(self, address: str) -> None:
        from cflib.crazyflie import Crazyflie  # noqa: PLC0415

        self.address = address
        self.last_packet = uptime()  # [s] time of any packet, also of an empty one, which only a radio sends
        self.exchanges = 0  # packets received
        self._longest_gap = 0.0  # [s] longest pause of two packets, see `take_gap`
        self.firmware: str | None = None  # version, as the drone says it
        self.replies: dict[int, tuple[int, int]] = {}  # replies of the planner, by command: number, last code
        self._last_answer = self.last_packet  # [s] packet with a content
        self._connected = threading.Event()
        self.error: str | None = None  # reason of the loss; None while connected
        self.answered = self._unsafe = False  # any packet was received; safelink is missing
        self.blocks: dict[str, Any] = {}
        self._periods: dict[str, int] = {}  # periods that were asked for, in units of 10 ms
        self._parameters: dict[int, tuple[str, str]] = {}  # asked for, by number: name, format
        self._values: dict[str, float] = {}  # answers about parameters
        self.trajectories = TrajectoryMemory(self._send)
        self.confirmed: Callable[[], None] = lambda: None  # called when a part of them, or a parameter, is confirmed
        cf = self.cf = Crazyflie()
        cf._toc_cache = _tables()
        cf.link_statistics.start = lambda: None  # its pings cost ten packets a second, and its thread can join itself
        cf.param.request_update_of_all_params = lambda: None
        cf.packet_received.add_callback(self._note_packet)
        cf.connected.add_callback(lambda _uri: self._connected.set())
        cf.link_established.add_callback(self._request_resending)
        cf.connection_failed.add_callback(lambda _uri, text: self._fail(text))
        cf.connection_lost.add_callback(lambda _uri, text: self._fail(text))
        cf.add_port_callback(int(Port.HIGH_LEVEL), self._reply)
        cf.add_port_callback(int(Port.PLATFORM), self._note_firmware)
        cf.add_port_callback(int(Port.PARAM), self._note_parameter)
        cf.add_port_callback(int(Port.MEMORY), self._note_memory)

    @property
    def gap(self) -> float:
        """Time since the last packet [s]; over a radio there is one for every answered poll."""
        return uptime() - self.last_packet

    def take_gap(self) -> float:
        """Longest gap between two packets since the last call that has ended [s]."""
        longest, self._longest_gap = self._longest_gap, 0.0
        return longest

    @property
    def busy(self) -> bool:
        """Whether a radio is silent, or was since the last `take_gap`: a packet would wait for the end of the gap."""
        return self.is_radio and max(self.gap, self._longest_gap) > BUSY_S

    def open(self, deadline: float, end: threading.Event) -> None:
        """Connect; give up at `deadline` on the clock `uptime` [s], or at `end`.

        Raises:
            SilentError: If no answer comes, answers cease, or safelink is missing.
            LinkError: If the driver fails, or at the deadline.
        """
        self.last_packet = self._last_answer = uptime()
        self.cf.open_link(self.address)
        if self.cf.link is not None and self.is_radio:
            self.cf.link.link_error_callback = None  # a packet that finds no room for 2 s would end the link
            self.cf.link._thread._radio = PromptRadio(self.cf.link._thread._radio)
        while not self._connected.wait(0.02):
            now = uptime()
            if self.error is not None:
                raise LinkError(self.error)
            if self._unsafe:
                # a drone that still has safelink on takes all packets of a session without it for repetitions
                raise SilentError("no safelink")
            if now - (self._last_answer if self.answered else self.last_packet) > (
                SILENCE_S if self.answered else FIRST_S
            ):
                raise SilentError("no answer")
            if now > deadline or end.is_set():
                raise LinkError("the connection was not set up in time")

    def start_log(self, name: str, rate_hz: float, variables: Mapping[str, str], logged: LogCallback) -> None:
        """Start a log block.

        Args:
            name: Name of the block.
            rate_hz: Rounded to the nearest possible period.
            variables: Names and types on the wire; variables that the firmware lacks are left out.
            logged: Called on cflib's thread with the time of arrival on the clock `uptime` [s], the stamp of the drone
                [ms, 24 bits] and the values.
        """
        from cflib.crazyflie.log import LogConfig  # noqa: PLC0415

        block = LogConfig(name, PERIODS_MS * max(1, round(1000.0 / rate_hz / PERIODS_MS)))
        for variable, type_ in variables.items():
            if self.cf.log.toc.get_element_by_complete_name(variable) is not None:
                block.add_variable(variable, type_)
        if not block.variables:
            return
        block.data_received_cb.add_callback(lambda stamp, values, _block: logged(uptime(), stamp, values))
        try:
            self.cf.log.add_config(block)
            block.start()
        except AttributeError as error:  # block too large, too many blocks, or link lost meanwhile
            raise LinkError(f"log block {name}: {error}") from error
        self.blocks[name], self._periods[name] = block, block.period

    def stop_log(self, name: str) -> None:
        """End a log block."""
        block = self.blocks.pop(name, None)
        if block is not None:
            block.delete()

    def restart_logs(self) -> None:
        """Create all log blocks again: the firmware removes them after a second without packets."""
        for block in list(self.blocks.values()):
            block.added = False
            block.start()

    def scale_logs(self, share: float) -> None:
        """Set the rates of all log blocks to a share of those asked for; not below 5 Hz."""
        for name, block in list(self.blocks.items()):
            period = self._periods[name]
            block.period = min(round(period / share), max(LONGEST_PERIOD, period))
            block.start()

    def send_parameter(self, parameter: str, value: float | None) -> None:
        """Set a parameter, or ask for its value (None), without waiting for the answer; see `parameter_answer`.

        Raises BodyError if the firmware has no such parameter, or a read-only one.
        """
        element = self._parameter(parameter)
        if element is None:
            raise BodyError(f"the firmware has no parameter {parameter}: is the name right, the firmware new enough?")
        if value is not None and element.access:
            raise BodyError(f"the parameter {parameter} cannot be set: it is read-only")
        self._parameters[element.ident] = parameter, element.pytype
        self._values.pop(parameter, None)
        data = crtp.IDENT.pack(element.ident)
        if value is not None:
            data += struct.pack(element.pytype, float(value) if element.pytype[-1] in "fde" else int(value))
        self._send(Port.PARAM, crtp.PARAM_READ if value is None else crtp.PARAM_WRITE, data)

    def parameter_answer(self, parameter: str) -> float | None:
        """Value of a parameter in the answer to the last `send_parameter`; None before it."""
        return self._values.get(parameter)

    def set_parameter(self, parameter: str, value: float) -> None:
        """Set a parameter; raises BodyError if the firmware refuses it, LinkError if no confirmation comes."""
        confirmed = self._ask(parameter, value)
        if abs(confirmed - value) > 1e-5 * max(1.0, abs(value)):  # floats travel with 24 bits
            raise BodyError(f"the parameter {parameter} is {confirmed:g}, not {value:g}")

    def has_parameter(self, parameter: str) -> bool:
        """Whether the firmware has a parameter."""
        return self._parameter(parameter) is not None

    def parameter_value(self, parameter: str) -> float | None:
        """Value of a parameter; None if the firmware has no such parameter; raises LinkError if no answer comes."""
        return self._ask(parameter, None) if self.has_parameter(parameter) else None

    def _parameter(self, parameter: str) -> Any:  # noqa: ANN401 - cflib's
        group, _, name = parameter.partition(".")
        return self.cf.param.toc.get_element(group, name)

    def _ask(self, parameter: str, value: float | None) -> float:
        """Answer about a parameter."""
        return self._repeat(
            lambda: self.send_parameter(parameter, value),
            lambda: self.parameter_answer(parameter),
            f"the parameter {parameter}",
        )

    def _repeat(self, ask: Callable[[], None], answer: Callable[[], float | None], about: str) -> float:
        """Answer to a question, which is repeated, since a drone may lose its answers in a gap."""
        deadline = uptime() + ANSWER_S
        again = 0.0
        while again == 0.0 or (answered := answer()) is None:
            now = uptime()
            if now > deadline or self.error is not None:
                raise LinkError(f"no answer about {about}")
            if now >= again:
                again = now + REPEAT_S
                ask()
            time.sleep(0.005)
        return answered

    def planner_reply(self, command: int) -> tuple[int, int]:
        """Number of replies to a high-level command so far, and the code of the last."""
        return self.replies.get(command, (0, 0))

    def ask_firmware(self) -> None:
        """Ask for the version of the firmware; `firmware` has it when the answer has come."""
        self._send(Port.PLATFORM, crtp.VERSIONS, bytes((crtp.FIRMWARE,)))

    def define_trajectories(self, *, stops: bool) -> None:
        """Tell the drone where its trajectories will be, which end in a stop of the motors or on the floor.

        Raises BodyError if it refuses, LinkError if it is silent.
        """
        memories = [memory.id for memory in self.cf.mem.mems if memory.type == MemoryKind.TRAJECTORY]
        if not memories:
            raise BodyError("the firmware has no memory for trajectories: update it")
        self.trajectories.memory, self.trajectories.stops = memories[0], stops
        if self.cf.platform.get_protocol_version() < crtp.RELATIVE_YAW:
            self.trajectories.start_command = HighLevel.START

        def answer() -> int | None:
            count, code = self.planner_reply(HighLevel.DEFINE)
            return code if count >= len(PLACES) else None

        if self._repeat(self.trajectories.define, answer, "trajectories"):
            raise BodyError("the firmware refuses uploaded trajectories: update it")

    def _send(self, port: Port, channel: int, data: bytes) -> None:
        from cflib.crtp.crtpstack import CRTPPacket  # noqa: PLC0415

        packet = CRTPPacket()
        packet.set_header(int(port), channel)
        packet.data = data
        self.cf.send_packet(packet)

    def close(self) -> None:
        """End the connection and its threads.

        cflib's own `close_link` first sends a setpoint of zero thrust: in the air the motors would stop, and on the
        ground the firmware would ignore the next session's planner.
        """
        cf = self.cf
        cf.incoming.stop()
        if cf.incoming.is_alive():
            cf.incoming.join(JOIN_S)
        updater = cf.param.param_updater
        link, cf.link = cf.link, None
        if link is not None:
            link.close()
        cf.close_link()
        if updater is not None:
            updater.request_queue.put(None)  # the updater may have missed the first one and would wait for ever
            updater.join(JOIN_S)

    def _request_resending(self, _uri: str) -> None:
        """Make cflib repeat its requests over UDP, which loses packets as a radio does; by default it does not."""
        if self.address.startswith("udp://"):
            self.cf.link.needs_resending = True

    @property
    def is_radio(self) -> bool:
        """Whether every answered poll brings a packet."""
        return self.address.startswith("radio://")

    def _note_packet(self, packet: Packet) -> None:
        now = uptime()
        self._longest_gap = max(self._longest_gap, now - self.last_packet)
        self.last_packet = now
        self.exchanges += 1
        if not self.answered:  # cflib has tried for safelink before it hands the first packet on
            self._unsafe = self.is_radio and getattr(self.cf.link, "needs_resending", False)
            self.answered = True
        if (packet.port, packet.channel) != crtp.NULL:
            self._last_answer = self.last_packet

    def _note_parameter(self, packet: Packet) -> None:
        data = bytes(packet.data)
        begin = {crtp.PARAM_READ: 3, crtp.PARAM_WRITE: 2}.get(packet.channel)
        if begin is None or len(data) < begin:
            return
        name, packing = self._parameters.get(crtp.IDENT.unpack_from(data)[0], ("", ""))
        if name and len(data) >= begin + struct.calcsize(packing):
            self._values[name] = float(struct.unpack_from(packing, data, begin)[0])
            self.confirmed()

    def _note_memory(self, packet: Packet) -> None:
        if packet.channel == crtp.MEMORY_WRITE:
            number, address = crtp.MEMORY.unpack_from(packet.data)
            if number == self.trajectories.memory:
                self.trajectories.note_answer(address, packet.data[crtp.MEMORY.size])
                self.confirmed()

    def _note_firmware(self, packet: Packet) -> None:
        if packet.data and packet.data[0] == crtp.FIRMWARE:
            self.firmware = bytes(packet.data[1:]).partition(b"\0")[0].decode(errors="replace")

    def _reply(self, packet: Packet) -> None:
        if len(packet.data) >= 4:
            count, _ = self.planner_reply(packet.data[0])
            self.replies[packet.data[0]] = count + 1, packet.data[3]

    def _fail(self, text: str) -> None:
        lines = [line.strip() for line in str(text).splitlines() if line.strip()]
        self.error = re.sub(r"^\w+: ", "", lines[-1]) if lines else "lost"  # the last line of a traceback
