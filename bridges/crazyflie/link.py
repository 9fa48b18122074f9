"""Connection to one Crazyflie through cflib, with the deadlines and the supervision that cflib lacks.

A lost connection is never repaired: it is closed, and a new object is made.
"""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from agents.body.interface import BodyError
from agents.protocols import crtp
from agents.protocols.crazyflie import dongle_of
from agents.protocols.crazyradio import software
from agents.protocols.crtp import Port
from bridges.crazyflie.dongle import plug_in

FIRST_S: Final = 0.6  # to the first packet; cflib never repeats its first two requests
SILENCE_S: Final = 1.0  # between two packets while the connection is set up
ANSWER_S: Final = 1.0  # to the confirmation of a parameter
JOIN_S: Final = 1.5  # cflib's threads check for their end once per second
PERIODS_MS: Final = 10.0  # log periods are multiples of this

LogCallback = Callable[[float, Mapping[str, float]], None]


class Packet(Protocol):
    """The part of cflib's packet that is used."""

    data: bytes


class LinkError(RuntimeError):
    """Connection failed or lost."""


class SilentError(LinkError):
    """No answer from the drone."""


def prepare(addresses: Sequence[str]) -> None:
    """Load cflib and its drivers, once per process, and plug in the software radios that the addresses name.

    Raises:
        BodyError: If cflib is not installed, or one radio is to be in several simulated airs.
    """
    try:
        import cflib.crtp  # noqa: PLC0415 - an optional extra, under another licence
    except ModuleNotFoundError:
        raise BodyError("Crazyflies need cflib (GPL-3.0), which is an extra: pip install -e '.[crazyflie]'") from None
    if not cflib.crtp.CLASSES:  # a second call would register every driver twice
        cflib.crtp.init_drivers()
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
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark" / "crazyflie"


class Link:
    """Connection to one Crazyflie; `prepare` must have been called."""

    def __init__(self, address: str) -> None:
        from cflib.crazyflie import Crazyflie  # noqa: PLC0415

        self.address = address
        self.last_packet = time.monotonic()  # [s]
        self.firmware: str | None = None  # version, as the drone says it
        self.replies: dict[int, tuple[int, int]] = {}  # of the planner, by command: number of replies, last code
        self._full = threading.Event()
        self._error: str | None = None
        self._answered = False
        self._blocks: dict[str, Any] = {}
        cf = self.cf = Crazyflie(rw_cache=str(cache()))
        cf.link_statistics.start = lambda: None  # its pings cost ten packets a second, and its thread can join itself
        cf.packet_received.add_callback(self._note_packet)
        cf.fully_connected.add_callback(lambda _uri: self._full.set())
        cf.link_established.add_callback(self._request_resending)
        cf.connection_failed.add_callback(lambda _uri, text: self._fail(text))
        cf.connection_lost.add_callback(lambda _uri, text: self._fail(text))
        cf.add_port_callback(int(Port.HIGH_LEVEL), self._reply)
        cf.add_port_callback(int(Port.PLATFORM), self._note_firmware)

    @property
    def answered(self) -> bool:
        """Whether any packet was received."""
        return self._answered

    @property
    def error(self) -> str | None:
        """Reason of the loss; None while connected."""
        return self._error

    def open(self, deadline: float, end: threading.Event) -> None:
        """Connect and read all parameters; give up at `deadline` on the monotonic clock [s], or at `end`.

        Raises:
            SilentError: If no answer comes, or answers cease.
            LinkError: If the driver fails, or at the deadline.
        """
        self.last_packet = time.monotonic()
        self.cf.open_link(self.address)
        while not self._full.wait(0.02):
            now = time.monotonic()
            if self._error is not None:
                raise LinkError(self._error)
            if now - self.last_packet > (SILENCE_S if self._answered else FIRST_S):
                raise SilentError("no answer")
            if now > deadline or end.is_set():
                raise LinkError("the connection was not set up in time")

    def has_variable(self, variable: str) -> bool:
        """Whether the firmware logs a variable."""
        return self.cf.log.toc.get_element_by_complete_name(variable) is not None

    def start_log(self, name: str, rate_hz: float, variables: Mapping[str, str], logged: LogCallback) -> None:
        """Start a log block.

        Args:
            name: Name of the block.
            rate_hz: Rounded to the nearest possible period.
            variables: Names and types on the wire; variables that the firmware lacks are left out.
            logged: Called on cflib's thread with the time of arrival on the monotonic clock [s] and the values.
        """
        from cflib.crazyflie.log import LogConfig  # noqa: PLC0415

        block = LogConfig(name, PERIODS_MS * max(1, round(1000.0 / rate_hz / PERIODS_MS)))
        for variable, type_ in variables.items():
            if self.has_variable(variable):
                block.add_variable(variable, type_)
        if not block.variables:
            return
        block.data_received_cb.add_callback(lambda _stamp, values, _block: logged(time.monotonic(), values))
        try:
            self.cf.log.add_config(block)
            block.start()
        except AttributeError as error:  # block too large, too many blocks, or link lost meanwhile
            raise LinkError(f"log block {name}: {error}") from error
        self._blocks[name] = block

    def stop_log(self, name: str) -> None:
        """End a log block."""
        block = self._blocks.pop(name, None)
        if block is not None:
            block.delete()

    def send_parameter(self, parameter: str, value: float) -> None:
        """Set a parameter without waiting for the confirmation.

        Raises:
            BodyError: If the firmware has no such parameter, or a read-only one.
        """
        try:
            self.cf.param.set_value(parameter, value)
        except KeyError:
            raise BodyError(
                f"the firmware has no parameter {parameter}: is the name right, the firmware new enough?"
            ) from None
        except AttributeError:
            if self._error is not None or self.cf.link is None:
                raise LinkError("lost") from None
            raise BodyError(f"the parameter {parameter} cannot be set: it is read-only") from None

    def set_parameter(self, parameter: str, value: float) -> None:
        """Set a parameter and wait for the confirmation.

        Raises:
            BodyError: If the firmware has no such parameter, a read-only one, or confirms another value.
            LinkError: If no confirmation comes.
        """
        group, name = parameter.split(".", 1) if "." in parameter else (parameter, "")
        confirmed: list[str] = []
        received = threading.Event()

        def confirm(_name: str, text: str) -> None:
            confirmed.append(text)
            received.set()

        self.cf.param.add_update_callback(group=group, name=name, cb=confirm)
        try:
            self.send_parameter(parameter, value)
            deadline = time.monotonic() + ANSWER_S
            while not received.wait(0.02):
                if time.monotonic() > deadline or self._error is not None:
                    raise LinkError(f"no answer about the parameter {parameter}")
        finally:
            self.cf.param.remove_update_callback(group=group, name=name, cb=confirm)
        if abs(float(confirmed[-1]) - value) > 1e-5 * max(1.0, abs(value)):  # floats travel with 24 bits
            raise BodyError(f"the parameter {parameter} is {confirmed[-1]}, not {value}")

    def parameter_value(self, parameter: str) -> float | None:
        """Last known value of a parameter; None if the firmware has no such parameter."""
        group, _, name = parameter.partition(".")
        text = self.cf.param.values.get(group, {}).get(name)
        return None if text is None else float(text)

    def planner_reply(self, command: int) -> tuple[int, int]:
        """Number of replies to a high-level command so far, and the code of the last."""
        return self.replies.get(command, (0, 0))

    def ask_firmware(self) -> None:
        """Ask for the version of the firmware; `firmware` has it when the answer has come."""
        from cflib.crtp.crtpstack import CRTPPacket  # noqa: PLC0415

        packet = CRTPPacket()
        packet.set_header(int(Port.PLATFORM), crtp.VERSIONS)
        packet.data = (crtp.FIRMWARE,)
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

    def _note_packet(self, _packet: object) -> None:
        self.last_packet = time.monotonic()
        self._answered = True

    def _note_firmware(self, packet: Packet) -> None:
        if packet.data and packet.data[0] == crtp.FIRMWARE:
            self.firmware = bytes(packet.data[1:]).partition(b"\0")[0].decode(errors="replace")

    def _reply(self, packet: Packet) -> None:
        if len(packet.data) >= 4:
            count, _ = self.planner_reply(packet.data[0])
            self.replies[packet.data[0]] = count + 1, packet.data[3]

    def _fail(self, text: str) -> None:
        lines = [line.strip() for line in str(text).splitlines() if line.strip()]
        self._error = re.sub(r"^\w+: ", "", lines[-1]) if lines else "lost"  # the last line of a traceback
