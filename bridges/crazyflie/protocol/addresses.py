"""The `device` table of a Crazyflie in the experiment file, and what its address may look like; the wire is `crtp`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import ceil, floor
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from agents.body.device_address import DeviceAddress
from agents.body.interface import BodyError, settings
from agents.vectors import NotNegative, Positive
from bridges.crazyflie.protocol.crazyradio import software

Rate = Annotated[float, Meta(ge=1, le=100)]
LogRate = Annotated[float, Meta(ge=5, le=100)]
Wait = Annotated[float, Meta(gt=0, le=60)]
# [1/s] up and down, that one Crazyradio carries without queues, unless more is measured: half of the 500 exchanges per
# second of cflib's maintainers (issue 258), with which a queue on board grows to seconds
PACKETS_PER_RADIO: Final = 250.0
MEASURED_SHARE: Final = 0.7  # share of the measured exchanges per second: full packets are slower than empty ones
YOUNG_S: Final = 0.1  # 99 % of poses are younger, or the rates are refused
TURNS: Final = 2  # turns of a radio through its robots, for which a pose waits at most, behind answers
PERIOD_S: Final = 0.01  # periods of logs are multiples of this
SETPOINT_PACKETS: Final = 2  # packets of one setpoint, each of which is answered: its trajectory, and the start of that
LAST_CHANNEL: Final = 125  # highest channel of a Crazyradio
DEFAULT_ADDRESS: Final = "E7E7E7E7E7"  # address of a Crazyflie as it is sold, and of cflib
ADDRESSES: Final = (
    re.compile(r"radio://[0-9A-Za-z]+/([0-9]|[1-9][0-9]|1[01][0-9]|12[0-5])/(250K|1M|2M)(/[0-9A-Fa-f]{1,10})?(\?.*)?"),
    re.compile(r"usb://[0-9]+"),
    re.compile(r"udp://[^/:\s]+:[0-9]{1,5}"),
)


class DeviceTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A table of the settings."""


class Lighthouse(DeviceTable, frozen=True, tag_field="system", tag="lighthouse"):
    """Lighthouse deck and base stations."""

    # geometry and calibration as the Crazyflie client saves them; None: what is stored on board
    file: str | None = None
    base_stations: Annotated[int, Meta(ge=1, le=16)] = 4  # number that the firmware knows


class Loco(DeviceTable, frozen=True, tag_field="system", tag="loco"):
    """Loco deck and anchors."""

    mode: Literal["auto", "twr", "tdoa2", "tdoa3"] = "auto"  # how ranges are measured
    # positions [m] of anchors 0, 1, ...; empty: keep the last ones
    anchors: list[tuple[float, float, float]] = []


class Outside(DeviceTable, frozen=True, tag_field="system", tag="external"):
    """Positions from outside (motion capture), passed on to the Crazyflie's own estimator."""

    rate_hz: Rate = 20.0  # largest rate at which they are forwarded
    # their standard deviation [m]; the estimator rings by positions that are 0.2 s late at 0.01, by 0.4 s at 0.1
    position_sigma: Positive = 0.1
    attitude: bool = False  # forward the yaw as well; an ambiguous marker set disturbs the estimator
    attitude_sigma: Positive = 0.05  # standard deviation of the attitude [rad]


class CrazyflieSettings(DeviceTable, frozen=True):
    """CrazyflieSettings of one Crazyflie."""

    stream_hz: Rate = 10.0  # largest rate of setpoints
    log_hz: LogRate = 20.0  # rate of pose, battery and supervisor; a log period is a multiple of 10 ms
    multiranger: bool = False  # has a Multi-ranger deck
    ranges_hz: Rate = 10.0  # rate of its ranges
    # its positioning system; None: set up on board already
    positioning: Lighthouse | Loco | Outside | None = None
    # on board; None: Kalman if a positioning system is named, else as it is
    estimator: Literal["auto", "complementary", "kalman", "ukf"] | None = None
    parameters: dict[str, float] = {}  # firmware parameters to set on connecting
    unprotected: list[str] = []  # those of them that may change a protection of the drone
    recover: bool = False  # recovers from a crash on connecting: only when the drone stands upright on the floor again
    arm: bool = True  # arm it before taking off, where the platform asks for that
    platform: Literal["crazyflie", "brushless"] = "crazyflie"  # used by the twin alone: a `brushless` one must be armed
    link: Literal["udp", "radio"] = "udp"  # used by the twin alone: `radio` puts a software Crazyradio between
    # for the twin only: files of cflib's cache with the parameters and the log variables that it lists; empty: built in
    tables: list[str] = []
    # for the twin only: gaps of its radio, begin after the take-off and duration [s]
    gaps: list[tuple[NotNegative, Positive]] = []
    connect_s: Wait = 60.0  # [s] limit for connecting, from its turn on its radio
    converge_s: Wait = 10.0  # [s] limit for the position estimate to settle

    @property
    def log_period(self) -> int:
        """Period of the pose, in units of 10 ms."""
        return max(1, round(1.0 / PERIOD_S / self.log_hz))

    @property
    def up_hz(self) -> float:
        """Packets per second to the drone."""
        return SETPOINT_PACKETS * self.stream_hz + (
            self.positioning.rate_hz if isinstance(self.positioning, Outside) else 0.0
        )

    @property
    def down_hz(self) -> float:
        """Packets per second from the drone."""
        return self._logs_hz + SETPOINT_PACKETS * self.stream_hz

    @property
    def _logs_hz(self) -> float:
        return self.log_hz + (self.ranges_hz if self.multiranger else 0.0)

    @property
    def packets_hz(self) -> float:
        """Packets per second over the radio, up and down, without answers, which are nearly empty."""
        return self.up_hz + self._logs_hz


def address(name: str, given: str) -> str:
    """The address of the robot `name`, if cflib accepts it; raises BodyError if not."""
    if not any(pattern.fullmatch(given) for pattern in ADDRESSES):
        form = "write radio://0/80/2M/E7E7E7E701, usb://0 or udp://127.0.0.1:19850"
        radio, *parts = given.removeprefix("radio://").split("/")
        if not radio.isalnum() and given.startswith("radio://"):
            form = f"{form}: the radio has a number or a serial number"
        elif parts and parts[0].isdecimal() and int(parts[0]) > LAST_CHANNEL:
            form = f"{form}: channels are 0 to {LAST_CHANNEL}"
        elif parts and parts[-1].lower().startswith("0x"):
            form = f"{form}: the address stands without 0x"
        raise BodyError(f"{name}: '{given}' is no Crazyflie's address; {form}")
    return given


def device_of(address: str) -> DeviceAddress:
    """Device of a Crazyflie's address, without what belongs to the computer (which radio, its options)."""
    scheme, _, rest = address.partition("?")[0].partition("://")
    if scheme == "radio":
        _, channel, rate, *own = rest.split("/")
        simulated = software(address)
        hosts = () if simulated is None else (simulated.host,)
        air = "" if simulated is None else f"{simulated.port} "
        own_address = (own[0] if own else DEFAULT_ADDRESS).upper()
        return DeviceAddress(address, hosts, (f"{air}radio {channel} {rate} {own_address:0>10}",))
    if scheme == "udp":
        host, _, port = rest.partition(":")
        return DeviceAddress(address, (host,), (str(int(port)),))
    return DeviceAddress(address, parts=(f"{scheme}://{int(rest)}",))


def air_of(address: str) -> tuple[int, str]:
    """Channel and data rate of a radio's address."""
    _, channel, rate, *_ = address.partition("?")[0].removeprefix("radio://").split("/")
    return int(channel), rate


def dongle_of(address: str) -> str:
    """Number or serial of the radio of an address; empty if there is none."""
    return address.split("/")[2] if address.startswith("radio://") else ""


def chosen(name: str, device: Mapping[str, Any], *, external: bool) -> CrazyflieSettings:
    """The settings of the robot `name`; `external` positions go to its estimator where no other system is named."""
    read = settings(CrazyflieSettings, name, device)
    if external and read.positioning is None:
        return msgspec.structs.replace(read, positioning=Outside())
    return read


def radio_loads(addresses: Sequence[str], each: Sequence[CrazyflieSettings]) -> list[float | None]:
    """Packets per second of all robots on the radio of each address; None without a radio."""
    radios = [dongle_of(address) for address in addresses]
    load: dict[str, float] = {}
    for radio, settings_ in zip(radios, each, strict=True):
        load[radio] = load.get(radio, 0.0) + settings_.packets_hz
    return [load[radio] if radio else None for radio in radios]


def capacity(each: Sequence[CrazyflieSettings], exchanges_hz: float) -> float:
    """Packets per second, up and down, that a radio carries of robots with these settings.

    One exchange takes one packet up and one down: of neither are there more than `MEASURED_SHARE` of the exchanges.
    """
    usable = MEASURED_SHARE * exchanges_hz
    up, down = sum(one.up_hz for one in each), sum(one.down_hz for one in each)
    asked = sum(one.packets_hz for one in each)
    return min(max(PACKETS_PER_RADIO, usable), usable * asked / max(up, down))


def oldest_pose(each: Sequence[CrazyflieSettings], exchanges_hz: float) -> float:
    """Age [s] below which 99 % of the poses of robots with these settings stay, on one radio."""
    return max(PERIOD_S * one.log_period for one in each) + TURNS * len(each) / exchanges_hz


def overload(radio: str, each: Sequence[CrazyflieSettings], exchanges_hz: float) -> str:
    """Reason why robots with these settings ask too much of a radio, and the rates that fit; empty if they do not."""
    asked, carried = sum(one.packets_hz for one in each), capacity(each, exchanges_hz)
    age = oldest_pose(each, exchanges_hz)
    if asked <= carried and age <= YOUNG_S:
        return ""
    slow = " (little: is this computer busy, the channel disturbed?)" if carried < PACKETS_PER_RADIO else ""
    if asked > carried:
        fault = f"ask for {asked:.0f} packets/s, up and down; it carries {carried:.0f}{slow}"
    else:
        fault = f"would have poses that are {age:.2f} s old, at {exchanges_hz:.0f} exchanges/s{slow}"
    return f"radio {radio}: {len(each)} robots {fault}: {_remedy(each, exchanges_hz)}"


def fitting(each: CrazyflieSettings, robots: int, exchanges_hz: float) -> tuple[int, CrazyflieSettings]:
    """Number of robots that a radio carries, up to `robots`, and the settings with rates at which it does.

    The number is 0 where it carries none.
    """
    for number in range(robots, 0, -1):
        for percent in range(100, 0, -1):
            lowered = _lowered(each, 0.01 * percent, number, exchanges_hz)
            some = [lowered] * number
            if sum(one.packets_hz for one in some) <= capacity(some, exchanges_hz) and (
                oldest_pose(some, exchanges_hz) <= YOUNG_S
            ):
                return number, lowered
    return 0, each


def _remedy(each: Sequence[CrazyflieSettings], exchanges_hz: float) -> str:
    """The rates that fit a radio, or the number of robots that do."""
    robots, lowered = fitting(each[0], len(each), exchanges_hz)
    if not robots:
        return "is another program using it?"
    rates = f"log_hz = {lowered.log_hz:g}, stream_hz = {lowered.stream_hz:g}"
    if isinstance(lowered.positioning, Outside):
        rates += f", positioning.rate_hz = {lowered.positioning.rate_hz:g}"
    if robots == len(each):
        return f"in each device table write {rates}, or plug in another radio"
    return f"plug in another radio; this one carries {robots}, with {rates}"


def _lowered(each: CrazyflieSettings, share: float, robots: int, exchanges_hz: float) -> CrazyflieSettings:
    """Settings with a share of the rates, in which poses are as young as they must be."""
    longest = max(floor((YOUNG_S - TURNS * robots / exchanges_hz) / PERIOD_S), 1)
    system = each.positioning
    if isinstance(system, Outside):
        system = msgspec.structs.replace(system, rate_hz=max(1.0, floor(share * system.rate_hz)))
    return msgspec.structs.replace(
        each,
        log_hz=floor(1.0 / PERIOD_S / min(ceil(each.log_period / share), longest)),
        stream_hz=max(1.0, floor(share * each.stream_hz)),
        positioning=system,
    )
