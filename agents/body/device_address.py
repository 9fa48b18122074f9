"""The device that an address names: equal for all names of a host, and for a port that is written or left out.

In doubt two addresses name one device, since a robot with two drivers is worse than a refusal.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, product
from typing import Final
from urllib.parse import urlsplit

LOOPBACK: Final = "127.0.0.1"
OWN: Final = ("::1", "0.0.0.0", "::", "127.0.1.1")
RESOLVE_S: Final = 2.0  # longest wait for the name servers


@dataclass(frozen=True)
class DeviceAddress:
    """Device that an address names.

    Two are the same if they have a host in common, or none, and all parts are equal that both have.

    Args:
        address: As it is written, for people.
        hosts: Names or addresses of its computer; empty for one that is not reached over a network.
        parts: What distinguishes devices of one host, such as port and path; an empty part is not written, and stands
            for any.
    """

    address: str = field(compare=False)
    hosts: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()

    def lock_keys(self, hosts: Mapping[str, Iterable[str]] | None = None) -> Iterator[tuple[str, bool]]:
        """Keys of the device, and whether each is its own: a key of two devices that is one's own makes them the same.

        `hosts` are the addresses of each host, see `resolved`; left out: no name server is asked.
        """
        resolved_to = [(hosts or {}).get(host, ()) for host in self.hosts]
        places = sorted({*map(canonical, self.hosts), *chain(*resolved_to)} - {""}) or [""]
        if places == [""] and not any(self.parts):
            yield self.address.lower(), True  # devices of which nothing is known have the text in common
        written = [("", part) if part else ("",) for part in self.parts]
        for place in places:
            for chosen in product(*written):
                if not (place or any(chosen)):  # all devices without a host have nothing in common
                    continue
                yield " ".join((place, *chosen)), chosen == self.parts


def plain_device(address: str) -> DeviceAddress | None:
    """The device of `WORD://HOST[%INTERFACE][:PORT][/PATH]` or `WORD:///FILE`; None for a word alone.

    What comes behind `?` are options. Links to files are followed.
    """
    if "://" not in address:
        return None
    try:
        parts = urlsplit(address)
        host, port = parts.hostname or "", str(parts.port or "")
    except ValueError:  # a body may have addresses of another form
        return DeviceAddress(address, parts=(address.lower(),))
    path = parts.path.rstrip("/")
    if not host:
        return DeviceAddress(address, parts=(os.path.realpath(path) if path else address.lower(),))
    interface = ""
    if ":" not in host:  # IPv6 has it in the address
        host, _, interface = host.partition("%")
    return DeviceAddress(address, (host,), (interface, port, path.lower()))


def canonical(host: str) -> str:
    """A host as far as no name server is asked: an address in its usual form, a name in small letters."""
    host = host.lower().removeprefix("[").removesuffix("]").rstrip(".")
    if host == "localhost":
        return LOOPBACK
    with suppress(OSError, ValueError):
        if "." in host and ":" not in host:
            host = socket.inet_ntoa(socket.inet_aton(host))  # 127.1 as well
    with suppress(ValueError):
        address = ipaddress.ip_address(host)
        host = str(getattr(address, "ipv4_mapped", None) or address)
    return LOOPBACK if host in OWN else host


def resolved(hosts: Iterable[str], limit_s: float = RESOLVE_S) -> dict[str, set[str]]:
    """Addresses of each host, those of this computer with the loopback; none that are not known after `limit_s` [s]."""
    found: dict[str, set[str]] = {host: set() for host in hosts}
    threads = [threading.Thread(target=_resolve, args=each, daemon=True) for each in found.items()]
    for each in threads:
        each.start()
    until = time.monotonic() + limit_s
    for each in threads:
        each.join(max(0.0, until - time.monotonic()))
    return {host: set(addresses) for host, addresses in found.items()}


def _resolve(host: str, found: set[str]) -> None:
    if host.isdecimal():
        return  # a number, such as that of a radio
    try:
        answers = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return
    addresses = {canonical(str(answer[4][0])) for answer in answers}
    found |= addresses | {LOOPBACK for each in addresses if _is_own(each)}


def _is_own(address: str) -> bool:
    """Whether an address is one of this computer; those of the loopback are devices of their own."""
    if address.startswith("127."):
        return False
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((address, 0))
    except (OSError, UnicodeError):
        return False
    return True
