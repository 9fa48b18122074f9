"""Zenoh endpoints, `protocol/host:port`, and behind `?` or `#` settings for Zenoh; and free ports."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, Self

from agents.errors import ExplainedError
from agents.network import lab

DEFAULT_PORT: Final = 7447
DEFAULT_ENDPOINT: Final = f"tcp/127.0.0.1:{DEFAULT_PORT}"
UNIX: Final = "unixsock-stream"
PROTOCOLS: Final = ("tcp", "tls", "quic", UNIX)
_WHY_NOT: Final = {
    "udp": "lost messages are not repeated, and a killed process is noticed late",
    "ws": "it shows no certificates",
    "wss": "its certificates are not checked by name",
    "serial": "two ends of a wire are no network",
}


class EndpointError(ExplainedError, ValueError):
    """An endpoint that cannot or must not be used, with the remedy."""


def protocol_refusal(endpoint: str) -> str:
    """Reason why the protocol of an endpoint is not supported, with the remedy; empty if it is."""
    protocol = endpoint.partition("/")[0]
    if protocol in PROTOCOLS:
        return ""
    why = _WHY_NOT.get(protocol, "there is no such protocol here")
    return f"'{endpoint}' cannot be used: {why}; write it like {DEFAULT_ENDPOINT}, or with tls, quic or {UNIX}/PATH"


@dataclass(frozen=True)
class Endpoint:
    """An endpoint in its parts."""

    protocol: str  # tcp, tls, quic, unixsock-stream
    host: str  # name or address, without brackets; the path of a Unix socket
    port: int  # 0 for a Unix socket
    rest: str = ""  # settings, with the `?` or `#` before them

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parses an endpoint; raises ValueError, which says how one is written, if it is none."""
        protocol, _, whole = text.partition("/")
        if protocol and whole and (why := protocol_refusal(text)):
            raise ValueError(why)
        end = min((at for mark in "?#" if (at := whole.find(mark)) >= 0), default=len(whole))
        address, rest = whole[:end], whole[end:]
        if protocol == UNIX and address:
            return cls(protocol, address, 0, rest)
        host, _, port = address.rpartition(":")
        if not (protocol and host and port.isdecimal() and 0 < int(port) < 65536):
            raise ValueError(f"'{text}' is not an endpoint; write it like {DEFAULT_ENDPOINT}")
        return cls(protocol, host.removeprefix("[").removesuffix("]"), int(port), rest)

    def __str__(self) -> str:
        if self.protocol == UNIX:
            return f"{self.protocol}/{self.host}{self.rest}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}/{host}:{self.port}{self.rest}"

    @property
    def is_loopback(self) -> bool:
        address = self._address
        return self.protocol == UNIX or self.host == "localhost" or (address is not None and address.is_loopback)

    @property
    def is_wildcard(self) -> bool:
        """Whether it stands for every address of a machine, for listening only."""
        address = self._address
        return address is not None and address.is_unspecified

    def at(self, host: str, port: int | None = None) -> Endpoint:
        """The same endpoint with another host name or port."""
        return replace(self, host=host, port=self.port if port is None else port)

    @property
    def _address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
        try:
            return ipaddress.ip_address(self.host)
        except ValueError:
            return None


def obstacle(endpoint: str, limit_s: float) -> str:
    """Reason of the system why an endpoint cannot be connected with; empty if it can, refuses, or says no reason.

    `endpoint` is one as Zenoh takes it, `limit_s` [s] the limit for its port to accept.
    """
    try:
        where = Endpoint.parse(endpoint)
        if where.protocol == UNIX:
            with socket.socket(socket.AF_UNIX) as knock:
                knock.connect(where.host)
        elif where.protocol == "quic":
            socket.getaddrinfo(where.host, where.port)
        else:
            socket.create_connection((where.host, where.port), limit_s).close()
    except (ConnectionRefusedError, TimeoutError, ValueError):
        return ""
    except OSError as error:
        return f"{where.host}: {error.strerror or error}"
    return ""


def free_endpoint(preferred_port: int = DEFAULT_PORT, protocol: str = "tcp") -> str:
    """A loopback endpoint to listen on: of the preferred port, or of any free one when that is taken."""
    for port in (preferred_port, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port in TIME_WAIT is free
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"
    raise EndpointError("no free TCP port on 127.0.0.1: end some of the processes that listen there")


def free_endpoints(count: int, protocol: str = "tcp") -> list[str]:
    """Different free loopback endpoints, from the default port upwards."""
    made: dict[str, None] = {}
    while len(made) < count:
        made[free_endpoint(DEFAULT_PORT + len(made), protocol)] = None
    return list(made)


Mode = Literal["client", "peer", "router"]

OWNER: Final = "#of="
TOGETHER: Final = "+"  # separates the names of robots that share a process


@dataclass(frozen=True)
class Ends:
    """Mode and endpoints of a session."""

    mode: Mode  # client, peer or router
    connect: list[str]  # a client connects to the first that answers, others to all
    listen: list[str]

    @property
    def visits(self) -> bool:
        """Whether it joins a mesh without being a member."""
        return self.mode == "peer" and not self.listen


def ends(endpoints: Sequence[str], name: str) -> Ends:
    """Mode and endpoints of the session of this name."""
    if not is_mesh(endpoints):
        return Ends("client", list(endpoints), [])
    own = next((number for number, each in enumerate(endpoints) if name in (owner(each), *owners(each))), None)
    if own is None:
        return Ends("peer", [unowned(each) for each in endpoints], [])
    return Ends("peer", [unowned(each) for each in endpoints[:own]], [unowned(endpoints[own])])


def is_mesh(endpoints: Sequence[str]) -> bool:
    return any(map(owner, endpoints))


def owned(endpoint: str, name: str) -> str:
    """The endpoint of a member of a mesh; it may carry its lab already."""
    plain, mark, folder = endpoint.partition(lab.MARK)
    return f"{plain}{OWNER}{name}{mark}{folder}"


def owner(endpoint: str) -> str:
    """Owner of an endpoint, several names with + between; empty for that of a router."""
    return endpoint.partition(lab.MARK)[0].partition(OWNER)[2]


def owners(endpoint: str) -> list[str]:
    return owner(endpoint).split(TOGETHER)


def unowned(endpoint: str) -> str:
    """The endpoint without its owner."""
    plain, mark, folder = endpoint.partition(lab.MARK)
    return f"{plain.partition(OWNER)[0]}{mark}{folder}"


def bare(endpoints: Sequence[str]) -> list[str]:
    """The endpoints as Zenoh takes them."""
    return [endpoint.partition(OWNER)[0] for endpoint in lab.bare(endpoints)]


def describe(endpoints: Sequence[str]) -> str:
    """Routers, or that they are a mesh, for people."""
    return "a mesh" if is_mesh(endpoints) else ", ".join(bare(endpoints))


def near(endpoints: Sequence[str], senders: Mapping[str, set[str]], names: Sequence[str]) -> list[str]:
    """Endpoints of a mesh for robots that share a process: their own, their neighbours', and those of services.

    `senders` are the neighbours of each robot of the experiment, `names` the robots of the process.
    """
    if not is_mesh(endpoints):
        return list(endpoints)
    wanted = {*names, *(sender for name in names for sender in senders[name])}
    wanted |= {other for other, own in senders.items() if own & set(names)}
    return [each for each in endpoints if not senders.keys() & set(owners(each)) or wanted & set(owners(each))]


def from_here(endpoint: str) -> str:
    """Endpoint with which this machine connects to its own listening socket."""
    parsed = Endpoint.parse(endpoint)
    return str(parsed.at("127.0.0.1")) if parsed.is_wildcard else endpoint
