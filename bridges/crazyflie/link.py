"""One connection to one Crazyflie through cflib, with the deadlines and the watch over it that cflib has not.

A connection that is lost is never mended: it is closed, and a new object is made.
"""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol

from agents.body.interface import BodyError
from agents.protocols.crtp import Port

FIRST_S: Final = 0.6  # to the first packet; the first two questions are never repeated by cflib
SILENCE_S: Final = 1.0  # between two packets while the connection is set up
ANSWER_S: Final = 1.0  # to the answer of a parameter
JOIN_S: Final = 1.5  # cflib's threads look up once per second
PERIODS_MS: Final = 10.0  # log periods are multiples of this

Logged = Callable[[float, Mapping[str, float]], None]


class Packet(Protocol):
    """What cflib hands out."""

    data: bytes


class LinkError(RuntimeError):
    """The connection cannot be made, or is lost."""


class SilentError(LinkError):
    """Nobody answers."""


def prepare() -> None:
    """Loads cflib and its drivers, once per process.

    Raises:
        BodyError: If it is not installed.
    """
    try:
        import cflib.crtp  # noqa: PLC0415 - an optional extra, under another licence
    except ModuleNotFoundError:
        raise BodyError("Crazyflies need cflib (GPL-3.0), which is an extra: pip install -e '.[crazyflie]'") from None
    if not cflib.crtp.CLASSES:  # a second call would register every driver twice
        cflib.crtp.init_drivers()
    logging.getLogger("cflib").setLevel(logging.CRITICAL)  # it logs tracebacks of what is reported here


def cache() -> Path:
    """Where the tables of contents of firmwares are kept: a known one connects ten times as fast."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark" / "crazyflie"


class Link:
    """A connection; `prepare` must have been called.

    Attributes:
        cf: cflib's object.
        heard: When the newest packet came, on the monotonic clock [s].
        replies: The newest answer of the planner to each high-level command: how many came, and the code.
    """

    def __init__(self, address: str) -> None:
        from cflib.crazyflie import Crazyflie  # noqa: PLC0415

        self.address = address
        self.heard = time.monotonic()
        self.replies: dict[int, tuple[int, int]] = {}
        self._full = threading.Event()
        self._error: str | None = None
        self._any = False
        self._blocks: dict[str, Any] = {}
        cf = self.cf = Crazyflie(rw_cache=str(cache()))
        cf.link_statistics.start = _nothing  # its pings cost ten packets a second, and its thread can join itself
        cf.packet_received.add_callback(self._hear)
        cf.fully_connected.add_callback(lambda _uri: self._full.set())
        cf.link_established.add_callback(self._insist)
        cf.connection_failed.add_callback(lambda _uri, text: self._fail(text))
        cf.connection_lost.add_callback(lambda _uri, text: self._fail(text))
        cf.add_port_callback(int(Port.HIGH_LEVEL), self._reply)

    @property
    def answered(self) -> bool:
        """Whether anything was heard at all."""
        return self._any

    @property
    def error(self) -> str | None:
        """Why it is lost, if it is."""
        return self._error

    def open(self, deadline: float, end: threading.Event) -> None:
        """Connects, with all parameters read; gives up at `deadline` on the monotonic clock [s], or at `end`.

        Raises:
            SilentError: If nobody answers, or nobody any more.
            LinkError: If the driver cannot, or the time is over.
        """
        self.heard = time.monotonic()
        self.cf.open_link(self.address)
        while not self._full.wait(0.02):
            now = time.monotonic()
            if self._error is not None:
                raise LinkError(self._error)
            if now - self.heard > (SILENCE_S if self._any else FIRST_S):
                raise SilentError("nobody answers")
            if now > deadline or end.is_set():
                raise LinkError("the connection was not set up in time")

    def has(self, variable: str) -> bool:
        """Whether the firmware logs a variable."""
        return self.cf.log.toc.get_element_by_complete_name(variable) is not None

    def log(self, name: str, rate_hz: float, variables: Mapping[str, str], logged: Logged) -> None:
        """Starts a log block; `logged` gets the time of arrival on the monotonic clock [s] and the values.

        Args:
            name: Of the block.
            rate_hz: Rounded to the next period that is possible.
            variables: Names and types in which they are sent; those that the firmware has not are left out.
            logged: Called on cflib's thread.
        """
        from cflib.crazyflie.log import LogConfig  # noqa: PLC0415

        block = LogConfig(name, PERIODS_MS * max(1, round(1000.0 / rate_hz / PERIODS_MS)))
        for variable, type_ in variables.items():
            if self.has(variable):
                block.add_variable(variable, type_)
        if not block.variables:
            return
        block.data_received_cb.add_callback(lambda _stamp, values, _block: logged(time.monotonic(), values))
        try:
            self.cf.log.add_config(block)
            block.start()
        except AttributeError as error:  # too large, too many; or the link went away meanwhile
            raise LinkError(f"log block {name}: {error}") from error
        self._blocks[name] = block

    def silence(self, name: str) -> None:
        """Ends a log block."""
        block = self._blocks.pop(name, None)
        if block is not None:
            block.delete()

    def ask(self, parameter: str, value: float) -> None:
        """Sets a parameter, without waiting.

        Raises:
            BodyError: If there is none of that name that can be set.
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

    def set(self, parameter: str, value: float) -> None:
        """Sets a parameter and waits until the Crazyflie has said it back.

        Raises:
            BodyError: If it has none of that name that can be set, or another value than wanted.
            LinkError: If it does not answer.
        """
        group, name = parameter.split(".", 1) if "." in parameter else (parameter, "")
        said: list[str] = []
        come = threading.Event()

        def hear(_name: str, text: str) -> None:
            said.append(text)
            come.set()

        self.cf.param.add_update_callback(group=group, name=name, cb=hear)
        try:
            self.ask(parameter, value)
            deadline = time.monotonic() + ANSWER_S
            while not come.wait(0.02):
                if time.monotonic() > deadline or self._error is not None:
                    raise LinkError(f"no answer about the parameter {parameter}")
        finally:
            self.cf.param.remove_update_callback(group=group, name=name, cb=hear)
        if abs(float(said[-1]) - value) > 1e-5 * max(1.0, abs(value)):  # floats travel with 24 bits
            raise BodyError(f"the parameter {parameter} is {said[-1]}, not {value}")

    def value(self, parameter: str) -> float | None:
        """What a parameter was when it was last heard of; None if there is none of that name."""
        group, _, name = parameter.partition(".")
        text = self.cf.param.values.get(group, {}).get(name)
        return None if text is None else float(text)

    def reply(self, command: int) -> tuple[int, int]:
        """How many answers to a high-level command came, and the code of the last."""
        return self.replies.get(command, (0, 0))

    def close(self) -> None:
        """Ends the connection and its threads.

        cflib's own way would send a setpoint of zero thrust before: in the air the motors would stop, and on the ground
        the next session's planner would be ignored.
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
            updater.request_queue.put(None)  # it may have missed the first one and would wait for ever
            updater.join(JOIN_S)

    def _insist(self, _uri: str) -> None:
        """UDP loses packets as a radio does: cflib must repeat its questions, which it does not do there by itself."""
        if self.address.startswith("udp://"):
            self.cf.link.needs_resending = True

    def _hear(self, _packet: object) -> None:
        self.heard = time.monotonic()
        self._any = True

    def _reply(self, packet: Packet) -> None:
        if len(packet.data) >= 4:
            count, _ = self.reply(packet.data[0])
            self.replies[packet.data[0]] = count + 1, packet.data[3]

    def _fail(self, text: str) -> None:
        lines = [line.strip() for line in str(text).splitlines() if line.strip()]
        self._error = re.sub(r"^\w+: ", "", lines[-1]) if lines else "lost"  # the last line of a traceback


def _nothing() -> None:
    """In place of what is not wanted."""
