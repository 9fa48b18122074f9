"""djitellopy without its threads: its parser and its sends, over sockets that are read here.

The library's own threads end for good at the first datagram that is not ASCII, and with them the telemetry of all
Tellos. Its `send_rc_control` sends nothing after the wall clock was set back.
"""

from __future__ import annotations

import errno
import importlib
import importlib.util
import logging
import socket
import sys
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from agents.body.interface import BodyError
from bridges.tello import protocol
from bridges.tello.pilot import Vendor

MAX_DATAGRAMS: Final = 100  # datagrams read at a time from a socket: a flood must not keep the pilots from their drones
DATAGRAM_BYTES: Final = 1024
GONE: Final = (errno.ENODEV, errno.ENXIO, errno.EBADF)  # errors of an interface that was unplugged
SETTINGS: Final = Path("/proc/sys/net/ipv4/conf")  # settings of interfaces, by their names


class TelloLibrary:
    """The library and the two UDP ports of this computer, for all Tellos of the process."""

    def __init__(
        self,
        control_port: int = protocol.CONTROL_PORT,
        state_port: int = protocol.STATE_PORT,
        interfaces: Iterable[str] = ("",),
    ) -> None:
        """`interfaces`: Network interfaces that lead to Tellos; an empty one: as the computer routes.

        Raises BodyError if the library is not installed, a port is taken, or an interface is not there.
        """
        self._module = _djitellopy()
        self._module.Tello.LOGGER.setLevel(logging.CRITICAL)  # else it logs every command and every wrong number
        names, self._wires = set(interfaces), dict[str, Wires]()
        try:
            for name in sorted(names):
                self._wires[name] = Wires(control_port, state_port, name, shared="" in names and len(names) > 1)
        except BodyError:
            self.close()
            raise
        # the library sends by `sendto` of its socket: this object, which knows the interface of each drone
        self._module.threads_initialized, self._module.client_socket = True, self
        self._drones: dict[str, dict[str, Any]] = self._module.drones

    def drone(self, place: protocol.TelloPlace) -> Vendor:
        """The drone at a place."""
        drone = self._module.Tello(host=place.device, retry_count=1)
        drone.address = (place.device, place.port)  # the library itself supports only the default ports
        vendor: Vendor = drone
        return vendor

    def sendto(self, data: bytes, address: tuple[str, int]) -> None:
        """Send a command of the library to a drone; raises OSError if that fails."""
        host, _, interface = address[0].partition("%")
        self._wires[interface].send(data, (host, address[1]))

    def receive(self) -> None:
        """Hand received datagrams to their drones; what is no answer and no state of a drone is dropped."""
        for name, wires in self._wires.items():
            zone = f"%{name}" if name else ""
            for data, host in _received(wires.answers):
                if (drone := host + zone) in self._drones:
                    self._drones[drone]["responses"].append(data)
            for data, host in _received(wires.states):
                if (drone := host + zone) in self._drones and data.isascii():
                    state = self._module.Tello.parse_state(data.decode("ascii"))
                    if "h" in state:
                        self._drones[drone]["state"] = state

    def close(self) -> None:
        """Free both ports."""
        for wires in self._wires.values():
            wires.close()
        self._module.drones.clear()


class Wires:
    """Sockets of both ports, on one network interface or on all."""

    def __init__(self, control_port: int, state_port: int, interface: str, *, shared: bool) -> None:
        """`shared`: Whether sockets of all interfaces have the same ports beside these."""
        self._ports, self._interface = (control_port, state_port), interface
        self._shared = shared
        self._open()

    def _open(self) -> None:
        answers, states = self._ports
        self.answers = _bind(answers, self._interface, shared=self._shared)
        try:
            self.states = _bind(states, self._interface, shared=self._shared)
        except BodyError:
            self.answers.close()
            raise

    def send(self, data: bytes, place: tuple[str, int]) -> None:
        """Send a datagram; an interface that was unplugged is looked for again."""
        try:
            self.answers.sendto(data, place)
        except OSError as error:
            if not self._interface or error.errno not in GONE:
                raise
            self.close()
            try:
                self._open()
            except BodyError:
                raise OSError(errno.ENODEV, f"{self._interface} is not there") from error
            self.answers.sendto(data, place)

    def close(self) -> None:
        """Free both ports."""
        self.answers.close()
        self.states.close()


def filters_answers(interface: str) -> bool:
    """Whether Linux drops what comes in by an interface and not from where it would send (`rp_filter`)."""
    found = [SETTINGS / name / "rp_filter" for name in ("all", interface) if interface]
    try:
        return max((int(file.read_text()) for file in found), default=0) == 1
    except (OSError, ValueError):
        return False


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


def _bind(port: int, interface: str, *, shared: bool) -> socket.socket:
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if interface:  # comes before the port: sockets on different interfaces may have the same
            wire.setsockopt(socket.SOL_SOCKET, _bind_to_device(), interface.encode() + b"\0")
        if shared:
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        wire.bind(("", port))
    except OSError as error:
        wire.close()
        if error.errno in GONE:
            known = ", ".join(name for _, name in socket.if_nameindex())
            raise BodyError(
                f"this computer has no network interface {interface!r}, only {known}: plug the Wi-Fi adapter in, or "
                "name another one"
            ) from error
        if error.errno == errno.EPERM:
            raise BodyError(
                f"this user may not choose the interface {interface!r} ({error.strerror}): Linux 5.7 and later let "
                "every user do so; an older one asks for CAP_NET_RAW"
            ) from error
        raise BodyError(
            f"UDP port {port} of this computer is taken ({error.strerror}): another program flies Tellos; end it, "
            "or give all Tellos the same `process`"
        ) from error
    wire.setblocking(False)
    return wire


def _bind_to_device() -> int:
    """The option of Linux that ties a socket to an interface; raises BodyError elsewhere."""
    option: int | None = getattr(socket, "SO_BINDTODEVICE", None)
    if option is None:
        raise BodyError("interfaces of Tellos are chosen on Linux alone: give each Tello an address of its own")
    return option
