"""CRTP, the protocol of the Crazyflie, version 12: ports, commands, answers, flags. No other module has a number of it.

One packet is a header byte (port, two set bits, channel) and up to 30 bytes; over UDP one datagram is one packet.
Source: the protocol pages of Bitcraze's documentation, and what cflib 0.1.34 puts on the wire.
"""

from __future__ import annotations

import errno
import math
from enum import IntEnum, IntFlag
from struct import Struct
from typing import Final

VERSION: Final = 12  # the first with a supervisor port
RELATIVE_YAW: Final = 10  # the first with `HighLevel.START_2`
PARAM_READ, PARAM_WRITE = 1, 2  # channels of `Port.PARAM`
NULL: Final = (15, 3)  # port and channel of a packet without content
VERSIONS: Final = 1  # channel of `Port.PLATFORM` on which a drone says its versions,
FIRMWARE: Final = 1  # question for its firmware, which is a text such as "2025.02"
MTU: Final = 30  # [bytes] largest payload
TRAJECTORIES: Final = 10  # largest number of defined trajectories
IN_MEMORY: Final = 1  # code of their only place
UNCOMPRESSED, COMPRESSED = 0, 1  # codes of their kinds
MEMORY_WRITE: Final = 2  # channel of `Port.MEMORY`
GREETING: Final = b"Bitcraze Crazyflie".ljust(MTU, b"\0")  # distinguishes a Crazyflie from a boot loader
LOG_PAYLOAD: Final = 26  # [bytes] values in one packet of a log block
LOG_BLOCKS: Final = 16
LOG_VARIABLES: Final = 128


class Port(IntEnum):
    """Part of the firmware that a packet addresses."""

    CONSOLE = 0
    PARAM = 2
    COMMANDER = 3
    MEMORY = 4
    LOG = 5
    LOCATION = 6
    SETPOINT = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9
    PLATFORM = 13
    LINK = 15


class LogStatus(IntEnum):
    """The last byte of an answer; cflib falls over log errors that are not among these."""

    OK = 0
    REFUSED = 1  # refused by the planner: taking off while it flies, landing while it lands
    UNKNOWN = errno.ENOENT
    IO = errno.EIO
    TOO_LARGE = errno.E2BIG
    NO_COMMAND = errno.ENOEXEC
    NO_ROOM = errno.ENOMEM
    BUSY = errno.EBUSY  # not armed, or locked
    EXISTS = errno.EEXIST


class Info(IntFlag):
    """State of the supervisor: its answer on port 9, and the log variable supervisor.info."""

    CAN_BE_ARMED = 1 << 0
    ARMED = 1 << 1
    AUTO_ARM = 1 << 2
    CAN_FLY = 1 << 3
    FLYING = 1 << 4
    TUMBLED = 1 << 5
    LOCKED = 1 << 6
    CRASHED = 1 << 7
    PLANNER_ACTIVE = 1 << 8
    PLANNER_FINISHED = 1 << 9
    PLANNER_DISABLED = 1 << 10


class Power(IntEnum):
    """Log variable pm.state."""

    BATTERY = 0
    CHARGING = 1
    CHARGED = 2
    LOW = 3
    SHUTDOWN = 4


class Toc(IntEnum):
    """Commands of the tables of contents, channel 0 of parameters and logs."""

    ITEM = 2
    INFO = 3


class Log(IntEnum):
    """Commands of log blocks, channel 1."""

    DELETE = 2
    START = 3
    STOP = 4
    RESET = 5
    CREATE = 6
    APPEND = 7


class Misc(IntEnum):
    """Commands about parameters, channel 3."""

    SET_BY_NAME = 0
    EXTENDED = 2
    STORE = 3
    STORED = 4
    CLEAR = 5
    EXTENDED_2 = 7
    DEFAULT_2 = 8


class Setpoint(IntEnum):
    """Kinds of low-level setpoints, channel 0 of port 7."""

    STOP = 0
    OLD_VELOCITY = 1  # the older ones turn the other way
    OLD_HEIGHT = 2
    CLIMB_RATE = 4
    OLD_HOVER = 5
    FULL_STATE = 6
    POSITION = 7
    VELOCITY = 8
    HEIGHT = 9
    HOVER = 10


class HighLevel(IntEnum):
    """Commands to the planner."""

    GROUP = 0
    OLD_TAKEOFF = 1
    OLD_LAND = 2
    STOP = 3
    OLD_GO_TO = 4
    START = 5  # start in protocol versions below 10
    DEFINE = 6
    TAKEOFF = 7
    LAND = 8
    TAKEOFF_VELOCITY = 9
    LAND_VELOCITY = 10
    SPIRAL = 11
    GO_TO = 12
    START_2 = 13


class SupervisorCommand(IntEnum):
    """Commands to the supervisor, channel 1, and its question, channel 0."""

    ARM = 1
    RECOVER = 2
    STOP = 3
    WATCHDOG = 4
    ASK = 12
    ANSWER = 0x80  # added to the command that is answered


class Platform(IntEnum):
    """Commands of the platform port, channel 0; those of the supervisor before it had a port."""

    ARM = 1
    RECOVER = 2


class PowerSwitch(IntEnum):
    """Commands to the radio's processor, behind `NRF` in packets to channel 3 of the link port."""

    ALL_OFF = 0x01
    OFF = 0x02
    ON = 0x03
    RESET = 0xF0
    RESET_BEGIN = 0xFF


class Location(IntEnum):
    """Messages of the localization port, channel 1."""

    LPP = 2
    STOP = 3
    WATCHDOG = 4
    POSE = 8
    STORE_LIGHTHOUSE = 11


class MemoryKind(IntEnum):
    """Kinds of memories."""

    EEPROM = 0x00
    DECK = 0x01
    LED_RING = 0x10
    TRAJECTORY = 0x12
    LOCO = 0x13
    LIGHTHOUSE = 0x14
    TESTER = 0x15
    LED_TIMING = 0x17
    DECKS = 0x19


ANCHOR_POSITION: Final = 1  # kind of LPP packet: where an anchor is, three floats [m]

TOC_INFO: Final = Struct("<BHI")
ITEM: Final = Struct("<BH")
IDENT: Final = Struct("<H")
VECTOR: Final = Struct("<fff")
POSE: Final = Struct("<fffffff")
CLIMB: Final = Struct("<ff?f")  # height [m], yaw [rad], keep yaw, time [s]
OLD_CLIMB: Final = Struct("<ff")  # height [m], time [s]
CLIMB_VELOCITY: Final = Struct("<f?f?f")  # height [m], relative, yaw [rad], keep yaw, mean speed [m/s]
OLD_GO_TO: Final = Struct("<?fffff")  # relative, x y z [m], yaw [rad], time [s]
GO_TO: Final = Struct("<??fffff")  # relative, linear, x y z [m], yaw [rad], time [s]
FOUR: Final = Struct("<ffff")
FULL_STATE: Final = Struct("<9hI3h")  # mm, mm/s, mm/s²; attitude in 32 bits; mrad/s
THRUST: Final = Struct("<fffH")  # roll, pitch, yaw rate [degrees], thrust
MEMORY: Final = Struct("<BI")  # memory, address
MEMORY_INFO: Final = Struct("<BBBI8x")
ANCHOR: Final = Struct("<fff?")

SPIRAL: Final = Struct("<??fffff")  # sideways, clockwise, angle [rad], first, last radius, climb [m], time [s]
DEFINE: Final = Struct("<BBIB")  # location, kind, address, number of pieces; the number of the trajectory precedes
START: Final = Struct("<??Bf")  # relative, reversed, trajectory, time scale
START_2: Final = Struct("<???Bf")  # relative position, relative yaw, reversed, trajectory, time scale
PIECE: Final = Struct("<33f")  # coefficients of x, y, z, yaw, constant first, and time [s]
NRF: Final = 0xFE  # addressee of power commands
ADDRESS: Final = bytes.fromhex("E7E7E7E7")  # address of the boot loader, without its first byte B1

MM: Final = 1e-3
SECONDS_MS: Final = 1000.0


def header(port: Port, channel: int) -> int:
    """The first byte of a packet."""
    return port << 4 | 0x0C | channel


def yaw_of(attitude: int) -> float:
    """Yaw [rad] of a quaternion in 32 bits: the number of the largest component, and the other three, 10 bits each."""
    largest = attitude >> 30
    q = [0.0] * 4
    rest = 1.0
    for i in (3, 2, 1, 0):
        if i != largest:
            size = (attitude & 0x1FF) / 0x1FF / math.sqrt(2.0)
            q[i] = -size if attitude & 0x200 else size
            rest -= size * size
            attitude >>= 10
    q[largest] = math.sqrt(max(rest, 0.0))
    x, y, z, w = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
