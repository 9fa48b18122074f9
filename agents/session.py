"""Sessions on the Zenoh network and what a robot declares on them: every setting in one place.

Everything that is received waits in a ring channel and is polled from the control loop. A callback would cost a thread
each, a slow one stops all reception of its session, and one that is left open keeps the interpreter from exiting.
A ring channel does none of this: it keeps the newest items and never blocks. The emergency stop alone cannot wait for
the next tick (`Alarm`).
"""

from __future__ import annotations

import ipaddress
import json
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, Protocol, Self, TypeVar

import zenoh
from zenoh.ext import (
    AdvancedPublisher,
    AdvancedSubscriber,
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    RecoveryConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)
from zenoh.handlers import Callback, Handler, RingChannel

from agents import access, lab, topology
from agents.endpoint import UNIX, refusal
from agents.promptness import prompt_threads
from agents.topology import Mode

T_co = TypeVar("T_co", covariant=True)

DEFAULT_PORT: Final = 7447
DEFAULT_ENDPOINT: Final = f"tcp/127.0.0.1:{DEFAULT_PORT}"

RETRY_S: Final = 0.1  # between attempts to open; an open client keeps to the `connect/retry` of its configuration
GATHER_S: Final = 1.0
LINK_S: Final = 0.01
FREED_S: Final = 3.0  # so long may an endpoint of a mesh stay taken by a robot that is started again
GHOST_S: Final = 2.5  # so long may the token of somebody who hangs stand after his end
LEASE_S: Final = 2.0  # whoever is silent for so long is held for dead
ROBOT_LEASE_S: Final = 1.2  # the same for robots: neighbours of one that hangs must know within 1.5 s
ASK_S: Final = 2.0  # whoever asks waits no longer for an answer
OPEN_S: Final = 3.0  # a router that answers nothing for so long is passed over for the next one
MOST_BYTES: Final = 4 * 1024 * 1024  # of a message that a router of a lab puts together; the largest is an experiment
HEARTBEAT_S: Final = 0.5  # how long the loss of the last pose before a silence goes unnoticed
POSES: Final = 16  # of one robot that wait to be polled
EVENTS: Final = 64  # of a run that are said again to who was cut off: without a router much happens at once

# 4 threads instead of 7 in each client and a sixth less CPU at 50 Hz. Zenoh reads it once, at the first open.
_RUNTIME: Final = (
    "(acc:(handover:app),tx:(handover:app),net:(handover:app),rx:(worker_threads:1),app:(worker_threads:1))"
)


class EndpointError(ValueError):
    """An endpoint that cannot or must not be used, with the remedy."""


class Unreachable(ConnectionError):
    """No router answers at the endpoints that were tried."""


class Polled(Protocol[T_co]):
    """Anything that hands out what arrived, one by one, and None when nothing waits."""

    def try_recv(self) -> T_co | None: ...


def config(
    mode: Mode,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    name: str | None = None,
    lease_s: float = LEASE_S,
    identity: str | None = None,
    rights: access.Rights | None = None,
) -> zenoh.Config:
    """The configuration of a session, of what `settings` says.

    Raises:
        EndpointError: As `settings`, and if Zenoh understands an endpoint in another way or not at all.
    """
    chosen = settings(
        mode, connect=connect, listen=listen, name=name, lease_s=lease_s, identity=identity, rights=rights
    )
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    made = zenoh.Config()
    for key, value in chosen.items():
        try:
            made.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            there = ", ".join(topology.bare((*connect, *listen)))
            raise EndpointError(f"{there}: {reason(error)}; write endpoints like {DEFAULT_ENDPOINT}") from None
    return made


def settings(
    mode: Mode,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    name: str | None = None,
    lease_s: float = LEASE_S,
    identity: str | None = None,
    rights: access.Rights | None = None,
) -> dict[str, object]:
    """What every session sets of Zenoh: no multicast, no gossip, no shared memory, listening on loopback only.

    With a lab (`agents.lab`) both ends show certificates, and listening beyond loopback is allowed.

    Args:
        mode: Robots are clients: a router forwards between clients, but not between two peers.
        connect: Endpoints of the routers; a client uses the first that answers and fails over to the others, and a
            router is linked with every one.
        listen: Loopback endpoints to listen on; a client needs none.
        name: Shown by `zenpark keys`.
        lease_s: After this silence [s] the others hold this session for dead. A killed process is noticed at once.
        identity: Whose certificate is shown, in a lab; `name` if left out.
        rights: Who may do what; a router of a lab needs them.

    Raises:
        EndpointError: If an endpoint is malformed, or one to listen on can be reached from outside this machine
            although there is no lab, or the lab has no such identity, or its router no rights to enforce.
    """
    for endpoint in (*connect, *listen):
        _check_form(endpoint)
    try:
        of_lab, folder = _of_lab([*connect, *listen], identity or name or "", bool(listen), rights)
    except lab.LabError as error:
        raise EndpointError(str(error)) from None
    connect, listen = topology.bare(connect), topology.bare(listen)
    if folder is None:
        for endpoint in listen:
            _check_loopback(endpoint)
    elif listen and rights is None:
        raise EndpointError(f"who listens in the lab {folder} must know who may do what: name the experiment")
    made: dict[str, object] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        # A client's open that waits inside Zenoh does not hear Ctrl-C: fail at once and try again in Python. Others
        # open without waiting, and seek whom they miss for as long as they live.
        "connect/timeout_ms": 0 if mode == "client" else -1,
        "connect/exit_on_failure": mode == "client",
        "open/return_conditions/connect_scouted": mode == "client",
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": round(lease_s * 1000),
        "transport/unicast/open_timeout": round(OPEN_S * 1000),
        "transport/unicast/accept_timeout": round(OPEN_S * 1000),
        "transport/shared_memory/enabled": False,
        "queries_default_timeout": round(ASK_S * 1000),
        "adminspace/enabled": True,  # read-only; how `zenpark keys` learns who is there
    }
    if name is not None:
        made["metadata"] = {"name": name}
    return made | of_lab


def _of_lab(
    endpoints: Sequence[str], identity: str, listens: bool, rights: access.Rights | None
) -> tuple[dict[str, object], Path | None]:
    """What the lab of some endpoints adds to a configuration, and its folder; nothing and None without one.

    Raises:
        LabError: If the lab has no such identity, or its register does not go with the rights.
    """
    folder = lab.of(endpoints)
    if folder is None:
        return {}, None
    settings = lab.settings(folder, identity, listens=listens)
    if rights is not None:
        known = lab.register(folder)
        if identity in known.identities and not known.identities[identity].hosts:
            raise lab.LabError(
                f"{identity} has a certificate with which one cannot listen, as in a mesh all do: `zenpark keys init` "
                f"with the file of the mesh gives such, or `zenpark keys issue {folder} NAME --host ADDRESS`"
            )
        settings["access_control"] = access.rules(rights, known)
        settings["low_pass_filter"] = access.sizes(rights)
        settings["transport/link/rx/max_message_size"] = MOST_BYTES
    return settings, folder


def _check_form(endpoint: str) -> None:
    protocol, slash, address = endpoint.partition("/")
    if not (protocol and slash and address and endpoint.isprintable()):
        raise EndpointError(f"'{endpoint}' is not an endpoint: write it like {DEFAULT_ENDPOINT}")
    if why := refusal(lab.bare([endpoint])[0]):
        raise EndpointError(why)


def _check_loopback(endpoint: str) -> None:
    """Refuses to listen where others could connect: without a lab there is no authentication."""
    protocol, _, address = endpoint.partition("/")
    if protocol == UNIX:
        return
    host = address.partition("#")[0].partition("?")[0].rpartition(":")[0].strip("[]")
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise EndpointError(
            f"will not listen on {endpoint}: whoever reaches it could command the robots. Make certificates with "
            "`zenpark keys init LAB FILE`, then listen on tls/... with --lab LAB; or listen on "
            f"{DEFAULT_ENDPOINT} and let other machines in through an SSH tunnel (ssh -R 7447:127.0.0.1:7447 HOST)"
        )


def open_session(
    endpoints: Sequence[str],
    *,
    name: str,
    wait_s: float = 10.0,
    stop: threading.Event | None = None,
    lease_s: float = LEASE_S,
    identity: str | None = None,
    rights: access.Rights | None = None,
    gather_s: float = GATHER_S,
) -> zenoh.Session:
    """A session on the network that some endpoints make; use it in a `with`.

    It is a client of the first router that answers. In a mesh (`agents.topology`) it is linked with all, some of
    whom may come later.

    Args:
        endpoints: Routers, best first; or members of a mesh.
        name: Who this is, as `zenpark keys` shows it.
        wait_s: How long to try [s].
        stop: Ends the wait when it is set.
        lease_s: See `config`.
        identity: Whose certificate is shown, where the endpoints are of a lab; `name` if left out.
        gather_s: How long members of a mesh that do not answer are waited for when others do [s].
        rights: Who may do what; a member of a mesh needs them in a lab, for nobody else enforces them.

    Raises:
        EndpointError: If an endpoint is malformed, or its lab has no such identity, or it cannot listen there.
        Unreachable: If nobody answered in time, or `stop` was set before anybody did.
    """
    ends = topology.ends(endpoints, name)
    settings = config(
        ends.mode,
        connect=ends.connect,
        listen=ends.listen,
        name=name,
        lease_s=lease_s,
        identity=identity,
        rights=rights if ends.listen else None,
    )
    gone = stop or threading.Event()
    deadline = time.monotonic() + (min(wait_s, FREED_S) if ends.listen else wait_s)
    while True:
        try:
            with prompt_threads():
                session = zenoh.open(settings)
        except zenoh.ZError as error:
            if time.monotonic() < deadline and not gone.wait(RETRY_S):
                continue
            if ends.listen:
                raise EndpointError(
                    f"{name} cannot listen on {', '.join(topology.bare(ends.listen))}: {reason(error)}. If it is on "
                    "the network already, end it first; or give it another endpoint in network.addresses"
                ) from None
        else:
            if not ends.visits or _gathered(session, len(ends.connect), gather_s, gone, deadline):
                return session
            session.close()  # type: ignore[no-untyped-call]
        raise Unreachable(_silence(endpoints, identity or name)) from None


def _gathered(session: zenoh.Session, members: int, gather_s: float, gone: threading.Event, deadline: float) -> bool:
    """Waits until a visitor is linked with all members of a mesh, or after a while with those that are there."""
    begun = time.monotonic()
    while (linked := len(session.info.transports())) < members:
        now = time.monotonic()
        if linked and now - begun > gather_s:
            return True
        if now > deadline or gone.wait(LINK_S):
            return linked > 0
    return True


def _silence(endpoints: Sequence[str], identity: str) -> str:
    folder = lab.of(endpoints)
    refused = (
        ""
        if folder is None
        else f", or it refuses the certificate of {identity} (`zenpark keys show {folder}` says until when it is valid)"
    )
    return (
        f"{'nobody' if topology.is_mesh(endpoints) else 'no router'} answers at "
        f"{', '.join(topology.bare(endpoints)) or 'no endpoint'}{refused}: "
        "`zenpark router` starts one, --connect names another"
    )


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
    """So many different ones, of the usual port and those after it where they are free."""
    made: dict[str, None] = {}
    while len(made) < count:
        made[free_endpoint(DEFAULT_PORT + len(made), protocol)] = None
    return list(made)


def connected(session: zenoh.Session) -> bool:
    """Whether the session has a router now, or a neighbour in a mesh. Costs 0.6 µs: poll it in the control loop."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


def links(session: zenoh.Session) -> int:
    """With how many others it is linked."""
    return len(session.info.transports())


def deserted(session: zenoh.Session) -> bool:
    """Whether nobody but other routers is connected to a router."""
    return all(transport.whatami == zenoh.WhatAmI.ROUTER for transport in session.info.transports())


def pose_publisher(session: zenoh.Session, key: str, mime: str, kept: int = 1) -> AdvancedPublisher:
    """A publisher whose last value is never lost, however rarely it speaks; nor are the last `kept`.

    Late joiners ask for the last value (cache), subscribers that were cut off ask again when they see the publisher
    reappear (detection), and a value lost before a silence is noticed by the heartbeat.
    """
    return declare_advanced_publisher(
        session,
        key,
        encoding=mime,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_HIGH,
        cache=CacheConfig(kept),
        sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        publisher_detection=True,
    )


def pose_subscriber(
    session: zenoh.Session, key: str, depth: int = POSES, kept: int = 1
) -> AdvancedSubscriber[Handler[zenoh.Sample]]:
    """The other end of `pose_publisher`: the newest `depth` samples wait in `.handler`.

    The history is limited to the `kept` of the publisher: without a limit a single frozen publisher stalls a wildcard
    for 10 s.
    """
    return declare_advanced_subscriber(
        session,
        key,
        RingChannel(depth),
        history=HistoryConfig(max_samples=kept, detect_late_publishers=True),
        recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def publisher(session: zenoh.Session, key: str, mime: str) -> zenoh.Publisher:
    """A plain publisher for what comes again soon (telemetry): dropped when the link is congested."""
    return session.declare_publisher(
        key, encoding=mime, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA
    )


def urgent_publisher(session: zenoh.Session, key: str, mime: str) -> zenoh.Publisher:
    """A publisher for what must overtake all else, and is said again: orders to a body elsewhere.

    Not express: then each sample fills a batch, a link has two of a priority, and a router drops what twenty robots
    say to one world at once.
    """
    return session.declare_publisher(
        key, encoding=mime, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME
    )


def subscriber(session: zenoh.Session, key: str, depth: int = 256) -> zenoh.Subscriber[Handler[zenoh.Sample]]:
    """The other end of `publisher`: the newest `depth` samples wait in `.handler`."""
    return session.declare_subscriber(key, RingChannel(depth))


class Alarm:
    """Samples that are obeyed as they come, without waiting for a control loop that may hang; it polls them later.

    The callback runs in the thread that receives, without one of its own: what it calls must be quick, and must not
    ask this session anything.
    """

    def __init__(
        self, session: zenoh.Session, key: str, obey: Callable[[zenoh.Sample], object], depth: int = 256
    ) -> None:
        """Listens on a key: each sample is given to `obey`; the newest `depth` wait besides."""
        self._obey = obey
        self._waiting: deque[zenoh.Sample] = deque(maxlen=depth)
        self._subscriber = session.declare_subscriber(key, Callback(self._take, indirect=False))

    def try_recv(self) -> zenoh.Sample | None:
        """See `Polled`."""
        return self._waiting.popleft() if self._waiting else None

    def _take(self, sample: zenoh.Sample) -> None:
        self._waiting.append(sample)
        self._obey(sample)


class LastValue:
    """Answers a plain `get` (z_get, REST) on a key with its last value, which the cache of an advanced publisher does
    not: call `answer` from the control loop."""

    def __init__(self, session: zenoh.Session, key: str, mime: str) -> None:
        self.key = key
        self.mime = mime
        self._payload: bytes | None = None
        self._queryable = session.declare_queryable(key, RingChannel(8))

    def hold(self, payload: bytes) -> None:
        """Remembers the value to answer with."""
        self._payload = payload

    def answer(self) -> int:
        """Replies to whoever asked since the last call, with nothing if there is no value yet; says to how many."""
        asked = 0
        for query in received(self._queryable.handler):
            with query:
                if self._payload is not None:
                    query.reply(self.key, self._payload, encoding=self.mime)
            asked += 1
        return asked

    def close(self) -> None:
        """Takes no more questions."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def last_value(session: zenoh.Session, key: str, mime: str) -> LastValue:
    """Makes the last value of a key visible to a plain `get`; polled, so it costs no thread."""
    return LastValue(session, key, mime)


def orders(session: zenoh.Session, key: str) -> zenoh.Queryable[Handler[zenoh.Query]]:
    """A queryable whose orders wait in `.handler`; reply inside `with query:` and on `key`, or the asker waits.

    Declare it before the liveliness token: whoever sees the token can then give orders.
    """
    return session.declare_queryable(key, RingChannel(8), complete=True)


def alive_token(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """Says that the owner of this session is there, until the token is undeclared or the session is gone."""
    return session.liveliness().declare_token(key)


def taken(session: zenoh.Session, key: str) -> bool:
    """Whether somebody else holds this liveliness token; one who was killed is given the time until that is noticed."""
    deadline = time.monotonic() + GHOST_S
    while list(session.liveliness().get(key, timeout=1.0)):
        if time.monotonic() > deadline:
            return True
        time.sleep(RETRY_S)
    return False


class AliveWatch:
    """Who comes (PUT) and goes (DELETE), as samples that wait in `handler`.

    A token on many keys at once (`park/**`) is nobody's life: it is left out.
    """

    def __init__(self, session: zenoh.Session, keyexpr: str) -> None:
        """Those already there come first."""
        self._subscriber = session.liveliness().declare_subscriber(keyexpr, RingChannel(256), history=True)

    @property
    def handler(self) -> Self:
        """See `Polled`."""
        return self

    def try_recv(self) -> zenoh.Sample | None:
        """See `Polled`."""
        for sample in received(self._subscriber.handler):
            if "*" not in str(sample.key_expr):
                return sample
        return None


def alive_watch(session: zenoh.Session, keyexpr: str) -> AliveWatch:
    """Who comes and goes, those already there first.

    When the router dies every token goes at once and comes back after the reconnection: ask `connected` before
    holding a robot for lost.
    """
    return AliveWatch(session, keyexpr)


def received(handler: Polled[T_co]) -> Iterator[T_co]:
    """What waits in a handler, oldest first, without blocking."""
    while (item := handler.try_recv()) is not None:
        yield item


def reason(error: zenoh.ZError) -> str:
    """The innermost reason in a message of Zenoh, without the place in its source."""
    return str(error).partition(" at /")[0].rpartition(": ")[2]
