"""djitellopy without its threads: its parser and its sends, over sockets that are read here.

The library's own threads end for good at the first datagram that is not ASCII, and with them the telemetry of all
Tellos. Its `send_rc_control` sends nothing after the wall clock was set back.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import socket
import sys
import types
from collections.abc import Iterator
from typing import Any, Final

from agents.body.interface import BodyError
from agents.protocols import tello as protocol
from bridges.tello.pilot import Vendor

MAX_DATAGRAMS: Final = 100  # datagrams read at a time from a socket: a flood must not keep the pilots from their drones
DATAGRAM_BYTES: Final = 1024


class TelloLibrary:
    """The library and the two UDP ports of this computer, for all Tellos of the process."""

    def __init__(self, control_port: int = protocol.CONTROL_PORT, state_port: int = protocol.STATE_PORT) -> None:
        """Raises BodyError if the library is not installed, or a port is taken."""
        self._module = _djitellopy()
        self._module.Tello.LOGGER.setLevel(logging.CRITICAL)  # else it logs every command and every wrong number
        self._answers = _bind(control_port)
        try:
            self._states = _bind(state_port)
        except BodyError:
            self._answers.close()
            raise
        self._module.threads_initialized, self._module.client_socket = True, self._answers
        self._drones: dict[str, dict[str, Any]] = self._module.drones

    def drone(self, host: str, port: int) -> Vendor:
        """A drone at an address."""
        drone = self._module.Tello(host=host, retry_count=1)
        drone.address = (host, port)  # the library itself supports only the default ports
        vendor: Vendor = drone
        return vendor

    def receive(self) -> None:
        """Hand received datagrams to their drones; what is no answer and no state of a drone is dropped."""
        for data, host in _received(self._answers):
            if host in self._drones:
                self._drones[host]["responses"].append(data)
        for data, host in _received(self._states):
            if host in self._drones and data.isascii():
                state = self._module.Tello.parse_state(data.decode("ascii"))
                if "h" in state:
                    self._drones[host]["state"] = state

    def close(self) -> None:
        """Free both ports."""
        self._answers.close()
        self._states.close()
        self._drones.clear()


def _djitellopy() -> Any:  # noqa: ANN401 - the library has no types
    if "av" not in sys.modules and importlib.util.find_spec("av") is None:
        sys.modules["av"] = types.ModuleType("av")  # only needed by the library's video, which is not used
    try:
        return importlib.import_module("djitellopy.tello")
    except ModuleNotFoundError as error:
        raise BodyError(
            f"flying a Tello needs djitellopy, which is not installed ({error.name} is missing): "
            "pip install -e '.[tello]'"
        ) from error


def _received(wire: socket.socket) -> Iterator[tuple[bytes, str]]:
    """Datagrams that have come so far, with the hosts of their senders."""
    for _ in range(MAX_DATAGRAMS):
        try:
            data, (host, _) = wire.recvfrom(DATAGRAM_BYTES)
        except OSError:  # nothing left, or an error of the network: both may end
            return
        yield data, host


def _bind(port: int) -> socket.socket:
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        wire.bind(("", port))
    except OSError as error:
        wire.close()
        raise BodyError(
            f"UDP port {port} of this computer is taken ({error.strerror}): another program flies Tellos; end it, "
            "or give all Tellos the same `process`"
        ) from error
    wire.setblocking(False)
    return wire
