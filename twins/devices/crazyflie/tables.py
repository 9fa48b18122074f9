"""Tables of contents: parameters and log variables of the firmware, as bytes on the wire."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Final

READ_ONLY: Final = 0x40
EXTENDED: Final = 0x10  # may be stored on board

PARAMETER_TYPES: Final = {
    "u8": (0x08, Struct("<B")),
    "u16": (0x09, Struct("<H")),
    "u32": (0x0A, Struct("<L")),
    "i8": (0x00, Struct("<b")),
    "i16": (0x01, Struct("<h")),
    "i32": (0x02, Struct("<i")),
    "float": (0x06, Struct("<f")),
}
LOG_TYPES: Final = {
    "u8": (1, Struct("<B")),
    "u16": (2, Struct("<H")),
    "u32": (3, Struct("<L")),
    "i8": (4, Struct("<b")),
    "i16": (5, Struct("<h")),
    "i32": (6, Struct("<i")),
    "float": (7, Struct("<f")),
    "half": (8, Struct("<e")),
}
LOG_FORMATS: Final = {number: (packing, name[0] in "ui") for name, (number, packing) in LOG_TYPES.items()}


@dataclass(frozen=True)
class Parameter:
    """One parameter: type, default, access."""

    name: str
    type: str
    default: float
    flags: int = 0

    @property
    def packing(self) -> Struct:
        """Packing of the value."""
        return PARAMETER_TYPES[self.type][1]

    @property
    def item(self) -> bytes:
        """Its entry in the table."""
        return entry(PARAMETER_TYPES[self.type][0] | self.flags, self.name)


@dataclass(frozen=True)
class LogVariable:
    """One log variable and its type on board."""

    name: str
    type: str

    @property
    def item(self) -> bytes:
        """Its entry in the table."""
        return entry(LOG_TYPES[self.type][0], self.name)


def entry(kind: int, name: str) -> bytes:
    """One entry of a table; the last NUL is required, because cflib always cuts one byte off."""
    group, variable = name.split(".")
    return bytes((kind,)) + f"{group}\0{variable}\0".encode()


@dataclass(frozen=True)
class Table:
    """One table: entries as bytes, numbers by name, and a checksum.

    cflib caches tables by checksum only, those of parameters and of logs in one folder: the checksum must depend on the
    content, and differ between the two.
    """

    items: tuple[bytes, ...]
    number: dict[str, int]
    crc: int

    @classmethod
    def build(cls, entries: Sequence[Parameter | LogVariable], salt: bytes) -> Table:
        """Build the table of these entries."""
        items = tuple(one.item for one in entries)
        return cls(items, {one.name: i for i, one in enumerate(entries)}, zlib.crc32(salt + b"".join(items)))


PARAMETERS: Final = (
    Parameter("commander.enHighLevel", "u8", 1),  # without effect, kept by the firmware for old clients
    Parameter("deck.bcLighthouse4", "u8", 0, READ_ONLY),
    Parameter("deck.bcLoco", "u8", 0, READ_ONLY),
    Parameter("deck.bcMultiranger", "u8", 0, READ_ONLY),
    Parameter("deck.bcFlow2", "u8", 0, READ_ONLY),
    Parameter("firmware.revision0", "u32", 0x2A18FC29, READ_ONLY),
    Parameter("firmware.revision1", "u16", 0x9D7B, READ_ONLY),
    Parameter("hlCommander.vtoff", "float", 0.5),
    Parameter("hlCommander.vland", "float", 0.5),
    Parameter("kalman.initialX", "float", 0.0),
    Parameter("kalman.initialY", "float", 0.0),
    Parameter("kalman.initialZ", "float", 0.0),
    Parameter("kalman.initialYaw", "float", 0.0),
    Parameter("kalman.resetEstimation", "u8", 0),
    Parameter("kalman.robustTdoa", "u8", 0),
    Parameter("kalman.robustTwr", "u8", 0),
    Parameter("lighthouse.method", "u8", 1),
    Parameter("lighthouse.systemType", "u8", 2, EXTENDED),
    Parameter("lighthouse.bsCalibReset", "u8", 0),
    Parameter("loco.mode", "u8", 0),
    Parameter("locSrv.extPosStdDev", "float", 0.01),
    Parameter("locSrv.extQuatStdDev", "float", 0.0045),
    Parameter("locSrv.enRangeStreamFP32", "u8", 0),
    Parameter("motorPowerSet.enable", "u8", 0),
    Parameter("pm.lowVoltage", "float", 3.2, EXTENDED),
    Parameter("pm.criticalLowVoltage", "float", 3.0, EXTENDED),
    Parameter("stabilizer.controller", "u8", 1, EXTENDED),
    Parameter("stabilizer.estimator", "u8", 0, EXTENDED),
    Parameter("stabilizer.stop", "u8", 0),
    Parameter("supervisor.landedTimeout", "u16", 3000, EXTENDED),
    Parameter("supervisor.prefltTimeout", "u16", 30000, EXTENDED),
)

LOGS: Final = tuple(
    LogVariable(name, type_)
    for type_, names in (
        ("float", "stateEstimate.x stateEstimate.y stateEstimate.z"),
        ("float", "stateEstimate.vx stateEstimate.vy stateEstimate.vz"),
        ("float", "stateEstimate.roll stateEstimate.pitch stateEstimate.yaw"),
        ("float", "stateEstimate.qx stateEstimate.qy stateEstimate.qz stateEstimate.qw"),
        ("i16", "stateEstimateZ.x stateEstimateZ.y stateEstimateZ.z"),
        ("i16", "stateEstimateZ.vx stateEstimateZ.vy stateEstimateZ.vz"),
        ("float", "stabilizer.roll stabilizer.pitch stabilizer.yaw stabilizer.thrust"),
        ("float", "kalman.varPX kalman.varPY kalman.varPZ"),
        ("float", "ctrltarget.x ctrltarget.y ctrltarget.z"),
        ("float", "locSrv.x locSrv.y locSrv.z"),
        ("float", "pm.vbat"),
        ("u16", "pm.vbatMV"),
        ("u8", "pm.batteryLevel"),
        ("i8", "pm.state"),
        ("u16", "supervisor.info"),
        ("u8", "sys.canfly sys.isFlying sys.isTumbled"),
        ("u8", "radio.rssi radio.isConnected"),
        ("u8", "lighthouse.status"),
        ("u16", "lighthouse.bsReceive lighthouse.bsActive lighthouse.bsGeoVal lighthouse.bsCalVal"),
        ("u8", "loco.mode"),
        ("u16", "ranging.state"),
        ("u16", "range.front range.back range.left range.right range.up range.zrange"),
    )
    for name in names.split()
)

PARAMETER_TABLE: Final = Table.build(PARAMETERS, b"parameters")
LOG_TABLE: Final = Table.build(LOGS, b"logs")
