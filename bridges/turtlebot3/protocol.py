"""The TurtleBot3 Burger as its ROS 2 node shows it: topics, rates, units, and the settings that reach it.

Shared by the bridge that drives one and the protocol twin that plays one. Sources: turtlebot3_node, the OpenCR firmware
`turtlebot3_ros2`, and turtlebot3_bringup's parameter files.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import copysign
from typing import Annotated, Final, Literal, get_args
from urllib.parse import parse_qsl

import msgspec
from msgspec import Meta

from agents.body.interface import BodyError, settings
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Distro, Style

COMMAND: Final = "cmd_vel"
ODOMETRY: Final = "odom"
SCAN: Final = "scan"
BATTERY: Final = "battery_state"

ODOMETRY_HZ: Final = 20.0
SCAN_HZ: Final = 5.0  # LDS-01; the LDS-02 turns twice as fast
BATTERY_HZ: Final = 1.0
STEP: Final = 0.01  # [m/s, rad/s] the node cuts speeds down to whole steps
RAYS: Final = 360
NEAREST, FARTHEST = 0.12, 3.5  # [m] range of the LDS-01
EMPTY_V, FULL_V = 10.5, 12.3  # the firmware maps these voltages to 0 and 100 %
ABSENT_V: Final = 7.0  # largest voltage at which the node says that there is no battery

_NAMESPACE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


class TurtleBot3Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `device` table of a TurtleBot3.

    Robot and twin read the same table, so that a switch between them changes no other setting.
    """

    distro: Distro = "jazzy"  # ROS 2 distribution of the robot; what its address says counts more
    domain: Annotated[int, Meta(ge=0, le=ros2.MAX_DOMAIN)] = 0  # ROS_DOMAIN_ID, for style "rmw"; likewise
    # whether cmd_vel is a TwistStamped (`enable_stamped_cmd_vel`); by distribution when left out
    stamped: bool | None = None
    # topic of commands: cmd_vel, or that of a watchdog in front of it
    command_topic: Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = COMMAND
    endpoint: str | None = None  # Zenoh router by which the robot is reached, where it is not that of the experiment
    # at the start pose of the experiment: the robot when its body is opened, or the origin of its odometry, which is
    # where its node was started
    origin: Literal["open", "boot"] = "open"
    style: Style = "ros2dds"  # style of the twin
    # [s] without a command after which the twin stops; None as in a TurtleBot3 as sold, which has no such watchdog
    watchdog_s: Annotated[float, Meta(gt=0)] | None = None


@dataclass(frozen=True)
class TurtleBotAddress:
    """Address of a robot: `ros2dds://tb3_0?distro=humble`, `rmw://tb3_0?domain=0&distro=jazzy`."""

    style: Style
    namespace: str
    distro: Distro
    domain: int

    def __str__(self) -> str:
        domain = f"domain={self.domain}&" if self.style == "rmw" else ""
        return f"{self.style}://{self.namespace}?{domain}distro={self.distro}"


def address(name: str, text: str, chosen: TurtleBot3Settings) -> TurtleBotAddress:
    """The address of a robot; raises BodyError if it is wrong, with robot and part."""
    style, _, rest = text.partition("://")
    path, _, query = rest.partition("?")
    namespace = path.strip("/")
    form = "write it like ros2dds://tb3_0 or rmw://tb3_0?domain=0&distro=jazzy"
    if style not in get_args(Style):
        raise BodyError(f"{name}: '{text}' is no TurtleBot3; {form}")
    if namespace and not _NAMESPACE.fullmatch(namespace):
        raise BodyError(f"{name}: '{namespace}' is no ROS namespace (letters, digits and _); {form}")
    asked = dict(parse_qsl(query, keep_blank_values=True))
    distro, domain = asked.pop("distro", chosen.distro), asked.pop("domain", str(chosen.domain))
    if asked:
        raise BodyError(f"{name}: '{next(iter(asked))}' is no part of '{text}'; {form}")
    if distro not in get_args(Distro):
        raise BodyError(f"{name}: distro '{distro}' is not known; write one of {', '.join(get_args(Distro))}")
    if not (domain.isascii() and domain.isdigit() and int(domain) <= ros2.MAX_DOMAIN):
        raise BodyError(f"{name}: domain '{domain}' is no number from 0 to {ros2.MAX_DOMAIN}")
    return TurtleBotAddress(style, namespace, distro, int(domain))  # type: ignore[arg-type]


def twin(name: str, chosen: TurtleBot3Settings) -> TurtleBotAddress:
    """The address of a robot's protocol twin: its own name is the namespace."""
    return TurtleBotAddress(
        chosen.style, re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII), chosen.distro, chosen.domain
    )


def address_on_routers(name: str, text: str, device: Mapping[str, object], *, of_twin: bool) -> TurtleBotAddress | None:
    """Address of a robot, or of its protocol twin, on routers of the experiment; None if it has an endpoint of its own.

    Raises as `address`.
    """
    chosen = settings(TurtleBot3Settings, name, device)
    if chosen.endpoint is not None:
        return None
    return twin(name, chosen) if of_twin else address(name, text, chosen)


def command_type(distro: Distro, stamped: bool | None) -> str:
    """Type of cmd_vel: Twist on Humble, TwistStamped from Jazzy on, unless the robot is set up otherwise."""
    if stamped is None:
        stamped = distro != "humble"
    return ros2.TWIST_STAMPED if stamped else ros2.TWIST


def cut(speed: float) -> float:
    """The speed that the node sets [m/s or rad/s]: C truncates to whole hundredths."""
    return int(speed * 100.0) / 100.0


def whole(speed: float, limit: float) -> float:
    """The nearest speed that the node does not change, within ±limit.

    It lies a fifth of a step beyond the hundredth, because 0.29 · 100 is less than 29 in binary numbers.
    """
    steps = min(round(abs(speed) / STEP), int(limit / STEP + 1e-9))
    return copysign((steps + 0.2) * STEP, speed) if steps else 0.0


def charge(voltage: float, percentage: float) -> float:
    """Charge from 0 to 1 of a BatteryState.

    ROS specifies a percentage from 0 to 1; the robot sends 0 to 100, and stops updating it when nearly empty. If the
    voltage is known the lower of the two counts.
    """
    full = percentage / 100.0 if percentage > 1.0 else percentage
    if voltage > 0.0:
        full = min(full, (voltage - EMPTY_V) / (FULL_V - EMPTY_V))
    return min(max(full, 0.0), 1.0)
