"""How a session takes part in a network: as a client of routers, as a router, or as a member of a mesh without one.

In a mesh every member listens at an endpoint of its own. Within the project that endpoint carries its owner's name,
`tcp/127.0.0.1:7501#of=CF01`, so that a list of endpoints says by itself which network it is. Of two members the one
that stands later in the list connects, so that they are linked once; whoever is not in it connects to all and does not
listen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from agents import lab
from agents.endpoint import Endpoint

Mode = Literal["client", "peer", "router"]

OWNER: Final = "#of="
TOGETHER: Final = "+"  # between the names of robots that share a process


@dataclass(frozen=True)
class Ends:
    """What a session does about endpoints.

    Attributes:
        mode: What it is to Zenoh.
        connect: Where it connects: a client at the first that answers, all others everywhere.
        listen: Where it listens.
    """

    mode: Mode
    connect: list[str]
    listen: list[str]

    @property
    def visits(self) -> bool:
        """Whether it comes into a mesh to which it does not belong."""
        return self.mode == "peer" and not self.listen


def ends(endpoints: Sequence[str], name: str) -> Ends:
    """What the session of this name does about the endpoints that it was given."""
    if not is_mesh(endpoints):
        return Ends("client", list(endpoints), [])
    own = next((number for number, each in enumerate(endpoints) if name in (owner(each), *owners(each))), None)
    if own is None:
        return Ends("peer", [unowned(each) for each in endpoints], [])
    return Ends("peer", [unowned(each) for each in endpoints[:own]], [unowned(endpoints[own])])


def is_mesh(endpoints: Sequence[str]) -> bool:
    """Whether endpoints are those of a mesh."""
    return any(map(owner, endpoints))


def owned(endpoint: str, name: str) -> str:
    """The endpoint of a member, which may carry its lab already."""
    plain, mark, folder = endpoint.partition(lab.MARK)
    return f"{plain}{OWNER}{name}{mark}{folder}"


def owner(endpoint: str) -> str:
    """Whose endpoint it is, several names with + between; empty for a router's."""
    return endpoint.partition(lab.MARK)[0].partition(OWNER)[2]


def owners(endpoint: str) -> list[str]:
    """The same, name by name."""
    return owner(endpoint).split(TOGETHER)


def unowned(endpoint: str) -> str:
    """The endpoint without its owner."""
    plain, mark, folder = endpoint.partition(lab.MARK)
    return f"{plain.partition(OWNER)[0]}{mark}{folder}"


def bare(endpoints: Sequence[str]) -> list[str]:
    """The endpoints as Zenoh takes them."""
    return [endpoint.partition(OWNER)[0] for endpoint in lab.bare(endpoints)]


def near(endpoints: Sequence[str], hears: Mapping[str, set[str]], names: Sequence[str]) -> list[str]:
    """What of a mesh concerns robots that share a process: their own endpoint, their neighbours', and the services'.

    Args:
        endpoints: Of all members.
        hears: Whom each robot of the experiment hears.
        names: The robots of the process.
    """
    if not is_mesh(endpoints):
        return list(endpoints)
    wanted = {*names, *(speaker for name in names for speaker in hears[name])}
    wanted |= {other for other, heard in hears.items() if heard & set(names)}
    return [each for each in endpoints if not hears.keys() & set(owners(each)) or wanted & set(owners(each))]


def from_here(endpoint: str) -> str:
    """How this machine reaches what listens at an endpoint of it."""
    parsed = Endpoint.parse(endpoint)
    return str(parsed.at("127.0.0.1")) if parsed.is_wildcard else endpoint
