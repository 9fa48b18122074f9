"""Protocol twins: simulated devices at the far end of a real wire, to which the unmodified vendor library connects.

A device moves its robots with the models of `twins` (there is no second model) and speaks its protocol on loopback
sockets. `twins.protocol` runs one in a process of its own.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec

from agents.arrays import Array
from agents.body.interface import BodyRequest


class Faults(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What goes wrong on purpose; everything left out goes right. Devices ignore what they cannot have."""

    loss: float = 0.0  # share of packets lost, in each direction
    delay_s: float = 0.0  # [s] of each packet that the device sends
    silent_from_s: float | None = None  # [s] from when on, by the device's clock, it says nothing and hears nothing
    silent_for_s: float = 1e9  # [s] for how long
    battery: float = 1.0  # charge at the start, 0 to 1
    drain: float = 1.0  # how many times faster than the maker says the battery drains
    refuse_arming: bool = False
    occluded_from_s: float | None = None  # [s] motion capture does not see the robots
    occluded_for_s: float = 1e9  # [s] for how long

    def silent(self, t: float) -> bool:
        """Whether the device is silent at time `t` [s]."""
        begin = self.silent_from_s
        return begin is not None and begin <= t < begin + self.silent_for_s

    def occluded(self, t: float) -> bool:
        """Whether motion capture sees nothing at time `t` [s]."""
        begin = self.occluded_from_s
        return begin is not None and begin <= t < begin + self.occluded_for_s


class Device(Protocol):
    """A simulated device for some robots of one kind.

    Attributes:
        addresses: One per row: the body's address by which the bridge reaches it, such as "udp://127.0.0.1:19850".
    """

    addresses: tuple[str, ...]

    def sockets(self) -> Sequence[socket.socket]:
        """What to wait on; asked again after every call of `serve`, for clients come and go."""
        ...

    def serve(self, ready: socket.socket, t: float) -> None:
        """Something can be read from one of the sockets, at time `t` [s]. Never blocks."""
        ...

    def advance(self, t: float) -> None:
        """Once per tick of `request.rate_hz`: the models move on to `t` [s]; what is due is sent."""
        ...

    def truth(self) -> tuple[Array, Array]:
        """Where the robots really are: (n, 3) [m] and yaw (n,) [rad]."""
        ...

    def close(self) -> None:
        """Closes the sockets."""
        ...


@dataclass(frozen=True)
class DeviceRequest:
    """What a device is made with: its robots as a body would get them, and what goes wrong on purpose."""

    body: BodyRequest
    faults: Faults


DeviceFactory = Callable[[DeviceRequest], Device]  # entry-point group `zenpark.devices`, by the word in `body`
