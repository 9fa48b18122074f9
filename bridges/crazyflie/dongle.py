"""Software Crazyradio: a USB device below cflib's own radio driver, for addresses with `?software=HOST:PORT`.

The driver above it is unmodified: addresses, retries, safelink and polls are those of a real radio. Each pair of a
write and a read is one exchange, over loopback, with the drones that a protocol twin simulates; it takes as long as it
takes a dongle.
"""

from __future__ import annotations

import socket
import time
from array import array
from collections.abc import Callable, Sequence
from typing import Any, Final

from bridges.crazyflie.protocol.crazyradio import ACK, ANSWER, EXCHANGE, RETRY_S, SWITCH_S, Simulated

ANSWER_S: Final = 0.1  # longest wait for the simulated air
MAX_ANSWER_BYTES: Final = 64  # [bytes] longest answer
REFUSED_S: Final = 0.01  # exchange with an air that is gone

# requests of the dongle's configuration
SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_RETRIES = 0x01, 0x02, 0x03, 0x06


class Dongle:
    """Stand-in for the `usb.core.Device` of a Crazyradio."""

    bcdDevice: Final = 0x0500  # noqa: N815 - name of pyusb: firmware 5.0, a Crazyradio 2.0
    serial_number: Final = "SOFTWARE"

    def __init__(self, air: Simulated) -> None:
        self.air = air
        self._ctx = self  # pyusb's resources of a device
        self._socket: socket.socket | None = None
        self._channel, self._rate, self._retries = 2, 2, 3
        self._address = bytes((0xE7,) * 5)
        self._number = 0
        self._status = b"\0"
        self._ends = self._extra = 0.0  # end of the exchange [s, monotonic]; time to add to the next one [s]

    def set_configuration(self, _number: int) -> None:
        """See pyusb: opens the device."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((self.air.host, self.air.port))
        self._socket.settimeout(ANSWER_S)

    def reset(self) -> None:
        """See pyusb."""

    def dispose(self, _device: object) -> None:
        """See pyusb: closes the device; a later `set_configuration` opens it again."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ctrl_transfer(self, _kind: int, request: int, **parameters: Any) -> array[int]:  # noqa: ANN401 - pyusb's
        """See pyusb: configuration of the radio."""
        if request == SET_CHANNEL:
            self._channel = parameters["wValue"]
            self._extra = SWITCH_S
        elif request == SET_RATE:
            self._rate = parameters["wValue"]
        elif request == SET_RETRIES:
            self._retries = parameters["wValue"]
        elif request == SET_ADDRESS:
            self._address = bytes(parameters["data_or_wLength"])
            self._extra = SWITCH_S
        return array("B")

    def write(self, endpoint: int, data: Sequence[int], timeout: int) -> int:
        """See pyusb: one exchange; its result is read afterwards."""
        begin = time.monotonic()
        packet = bytes(data)
        self._number = (self._number + 1) % 2**32
        request = EXCHANGE.pack(self._number, self._channel, self._rate, self._address, self._retries)
        self._status = self._exchange(request + packet)
        status = self._status[0]
        repeated = status >> 4 if status & ACK else self._retries
        self._ends = begin + 1.0 / self.air.hz + self._extra + repeated * RETRY_S
        self._extra = 0.0
        return len(packet)

    def read(self, endpoint: int, size: int, timeout: int) -> array[int]:
        """See pyusb: status byte and acknowledgement of the last exchange."""
        time.sleep(max(0.0, self._ends - time.monotonic()))
        return array("B", self._status)

    def _exchange(self, request: bytes) -> bytes:
        assert self._socket is not None
        try:
            self._socket.send(request)
            while True:
                answer = self._socket.recv(MAX_ANSWER_BYTES)
                number, status = ANSWER.unpack_from(answer)
                if number == self._number:  # else the late answer of an earlier exchange
                    return bytes((status,)) + answer[ANSWER.size :]
        except TimeoutError:
            return b"\0"
        except OSError:  # the air is gone: no drone answers
            self._extra = REFUSED_S
            return b"\0"


def plug_in(airs: dict[int, Simulated]) -> None:
    """Let cflib find software dongles, by number, beside the real ones that are plugged in."""
    from cflib.drivers import crazyradio  # noqa: PLC0415 - an optional extra

    find: Callable[..., Any] = getattr(crazyradio, "_find_real_devices", crazyradio._find_devices)
    dongles = {number: Dongle(air) for number, air in airs.items()}

    def found(serial: str | None = None) -> Any:  # noqa: ANN401 - pyusb's
        if serial is not None:
            return find(serial)
        plugged = dict(enumerate(find())) | dongles
        return [plugged.get(number) for number in range(max(plugged) + 1)]

    crazyradio._find_real_devices = find
    crazyradio._find_devices = found
