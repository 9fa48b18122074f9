"""Memories of a Crazyflie: EEPROM, trajectories, decks, Loco anchors, Lighthouse base stations, test of the link."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final
from zlib import crc32

from bridges.crazyflie.protocol.crtp import ANCHOR, MemoryKind

STATIONS: Final = 4  # the firmware's default
ANCHORS: Final = 8
PAGE: Final = 0x100
ONE_WIRE_BYTES: Final = 112  # size of a deck's memory
GEOMETRY_BYTES: Final = 49  # origin, rotation, valid
CALIBRATION_BYTES: Final = 61  # two sweeps of seven floats, identifier, valid
CALIBRATION: Final = 0x1000  # address of the calibrations
ACTIVE: Final = 0x1000  # address of the list of active anchors
ANCHOR_PAGES: Final = 0x2000

BOARDS: Final = {"bcDWM1000": 0x06, "bcMultiranger": 0x0C, "bcFlow2": 0x0F, "bcLighthouse4": 0x10}  # product numbers
DECK_VERSION: Final = 3  # version of the list of deck memories, which is empty otherwise

SIZES: Final = {
    MemoryKind.EEPROM: 0x20,
    MemoryKind.LED_RING: 24,
    MemoryKind.LED_TIMING: 0x400,
    MemoryKind.DECKS: 0x2000,
    MemoryKind.TRAJECTORY: 4096,
    MemoryKind.LOCO: ANCHOR_PAGES + PAGE * 0x100,
    MemoryKind.LIGHTHOUSE: 2 * CALIBRATION,
    MemoryKind.TESTER: 0x1000,
}


class Memories:
    """The memories of one Crazyflie, numbered in the order of `kinds`; those of its decks follow."""

    kinds: Final = tuple(SIZES)

    def __init__(self, decks: Sequence[str] = ()) -> None:
        """`decks`: names of `BOARDS`."""
        self.decks = [_board(name, BOARDS[name]) for name in decks]
        self._bytes = {kind: bytearray(size) for kind, size in SIZES.items()}
        loco = self._bytes[MemoryKind.LOCO]
        for where in (0, ACTIVE):  # all anchors are active, without positions
            loco[where : where + 1 + ANCHORS] = bytes((ANCHORS, *range(ANCHORS)))
        self._bytes[MemoryKind.DECKS][0] = DECK_VERSION
        settings = b"0xBC" + struct.pack("<BBBffBI", 1, 80, 2, 0.0, 0.0, 0xE7, 0xE7E7E7E7)  # radio, trim, address
        self._bytes[MemoryKind.EEPROM][: len(settings) + 1] = settings + bytes((sum(settings) % 0x100,))
        self.write_errors = 0  # errors of the tester: bytes that are not their address
        self.stored = (0, 0)  # masks of the stations with a geometry, and a calibration, that survives a restart

    def restart(self) -> None:
        """Forget what does not survive switching off and on: the trajectories."""
        self._bytes[MemoryKind.TRAJECTORY] = bytearray(SIZES[MemoryKind.TRAJECTORY])

    @property
    def listed(self) -> list[tuple[int, int]]:
        """Kind and size [bytes] of each memory."""
        return [*SIZES.items(), *[(MemoryKind.DECK, ONE_WIRE_BYTES)] * len(self.decks)]

    def read_number(self, number: int, address: int, count: int) -> bytes | None:
        """Read by the number of a memory, see `read`."""
        if number < len(self.kinds):
            return self.read(self.kinds[number], address, count)
        if number >= len(self.listed) or address + count > ONE_WIRE_BYTES:
            return None
        return self.decks[number - len(self.kinds)][address : address + count]

    @staticmethod
    def size(kind: MemoryKind) -> int:
        """Size of a memory [bytes]."""
        return SIZES[kind]

    def read(self, kind: MemoryKind, address: int, count: int) -> bytes | None:
        """Read `count` bytes from `address` on; None at an invalid address."""
        if kind == MemoryKind.TESTER:
            return bytes((address + k) & 0xFF for k in range(count))
        data = self._bytes[kind]
        if address + count > len(data) or not self._exists(kind, address):
            return None
        return bytes(data[address : address + count])

    def write(self, kind: MemoryKind, address: int, data: bytes) -> bool:
        """Write `data` to `address`; False at an invalid address."""
        if kind == MemoryKind.LOCO or address + len(data) > SIZES[kind] or not self._exists(kind, address):
            return False
        if kind == MemoryKind.TESTER:
            self.write_errors += sum(value != (address + k) & 0xFF for k, value in enumerate(data))
        self._bytes[kind][address : address + len(data)] = data
        return True

    def set_anchor(self, anchor: int, x: float, y: float, z: float) -> None:
        """Store the position of an anchor [m]."""
        where = ANCHOR_PAGES + PAGE * anchor
        self._bytes[MemoryKind.LOCO][where : where + ANCHOR.size] = ANCHOR.pack(x, y, z, True)

    def anchors(self) -> dict[int, tuple[float, float, float]]:
        """Positions [m] of the anchors that have one."""
        loco, known = self._bytes[MemoryKind.LOCO], {}
        for anchor in range(ANCHORS):
            x, y, z, valid = ANCHOR.unpack_from(loco, ANCHOR_PAGES + PAGE * anchor)
            if valid:
                known[anchor] = (x, y, z)
        return known

    def clear_stations(self) -> None:
        """Erase geometries and calibrations, as a change of the Lighthouse version does."""
        self._bytes[MemoryKind.LIGHTHOUSE] = bytearray(SIZES[MemoryKind.LIGHTHOUSE])

    @property
    def geometries(self) -> int:
        """Mask of the base stations with valid geometry."""
        return self._valid(0, GEOMETRY_BYTES)

    @property
    def calibrations(self) -> int:
        """Mask of the base stations with valid calibration."""
        return self._valid(CALIBRATION, CALIBRATION_BYTES)

    def _valid(self, begin: int, size: int) -> int:
        data = self._bytes[MemoryKind.LIGHTHOUSE]
        return sum((data[begin + PAGE * i + size - 1] != 0) << i for i in range(STATIONS))

    @staticmethod
    def _exists(kind: MemoryKind, address: int) -> bool:
        """Whether an address is valid: pages of base stations beyond the firmware's number are not."""
        return kind != MemoryKind.LIGHTHOUSE or address % CALIBRATION < STATIONS * PAGE


def _board(name: str, product: int) -> bytes:
    """Content of a deck's 1-wire memory: header and elements, each with a checksum."""
    header = struct.pack("<BIBB", 0xEB, 0, 0xBC, product)
    parts = b"".join(
        bytes((number, len(text))) + text for number, text in ((1, name.encode()), (2, b"A"))
    )  # board name, revision
    elements = bytes((0, len(parts))) + parts
    content = b"".join(part + bytes((crc32(part) & 0xFF,)) for part in (header, elements))
    return content.ljust(ONE_WIRE_BYTES, b"\xff")
