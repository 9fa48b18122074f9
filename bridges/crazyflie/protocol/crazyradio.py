"""Crazyradio: safelink, and the datagrams between a software dongle and the simulated drones in the air.

One exchange is one transmission of a packet and its acknowledgement: the only way in which a Crazyflie can send.
Source: Bitcraze's pages on the radio protocol, and the firmware of the radio chip (crazyflie2-nrf-firmware, esb.c).
"""

from __future__ import annotations

from struct import Struct
from typing import Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

NULL: Final = 0xF3  # header of a packet without content; the bits 0x0C are the counters of safelink
COUNTERS: Final = 0x0C
UP, DOWN = 0x08, 0x04  # counter bits of a packet
SAFELINK: Final = 0x05  # second byte of the request that switches safelink on or off
QUEUE: Final = 200  # packets that wait in a Crazyflie for an exchange
ACTIVITY_S: Final = 1.0  # [s] silence after which the firmware removes all log blocks and empties its queue
RETRY_S: Final = 0.0006  # one more transmission within an exchange
SWITCH_S: Final = 0.0003  # a change of the address or channel
ACK: Final = 0x01  # bit of the status byte; the number of retransmissions is above bit 4

# serial number of the exchange, channel, data rate (0: 250K, 1: 1M, 2: 2M), address, largest number of retransmissions
EXCHANGE: Final = Struct("<IBB5sB")
ANSWER: Final = Struct("<IB")  # serial number of the exchange, status byte
DATA_RATES: Final = {"250K": 0, "1M": 1, "2M": 2}


class Simulated(NamedTuple):
    """A simulated air, and the speed of a dongle in it."""

    host: str
    port: int
    hz: float  # exchanges per second


def software(address: str) -> Simulated | None:
    """The simulated air that the address of a Crazyflie names; None for a real radio."""
    options = parse_qs(urlsplit(address).query)
    if "software" not in options:
        return None
    host, _, port = options["software"][-1].rpartition(":")
    return Simulated(host, int(port), float(options.get("hz", ["500"])[-1]))


def software_address(drone: str, host: str, port: int, hz: float) -> str:
    """Address of a simulated Crazyflie; `drone` as in radio://0/80/2M/E7E7E7E701."""
    return f"{drone}?software={host}:{port}&hz={hz:g}"
