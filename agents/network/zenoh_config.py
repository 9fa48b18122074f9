"""Settings of Zenoh sessions."""

from __future__ import annotations

import ipaddress
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import zenoh

from agents.network import access_control, lab
from agents.network import endpoints as topology
from agents.network.endpoints import DEFAULT_ENDPOINT, UNIX, EndpointError, Mode, protocol_refusal

LEASE_S: Final = 2.0  # a peer silent for this long is considered dead
ASK_S: Final = 2.0  # limit for a reply to a query
OPEN_S: Final = 3.0  # limit of a handshake,
NEXT_S: Final = 1.0  # patience where there is another router
# Longest wait for a member that does not read: it is then disconnected, or in the second case not sent the message. Who
# waits holds up all others meanwhile. Zenoh's own limits are 5 s and 50 ms.
BLOCKED_S: Final = 0.02
_WAITS: Final = (
    "transport/link/tx/queue/congestion_control/block/wait_before_close",
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments",
)
MOST_BYTES: Final = 4 * 1024 * 1024  # largest message that a router of a lab puts together: an experiment

# 4 threads instead of 7 in each client and a sixth less CPU at 50 Hz. Zenoh reads it once, at the first open.
_RUNTIME: Final = (
    "(acc:(handover:app),tx:(handover:app),net:(handover:app),rx:(worker_threads:1),app:(worker_threads:1))"
)


def config(settings: Mapping[str, object]) -> zenoh.Config:
    """The configuration of a session with these settings; raises EndpointError if Zenoh does not accept an endpoint."""
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    made = zenoh.Config()
    for key, value in settings.items():
        try:
            made.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            what = ", ".join(value) if isinstance(value, list) else f"{key} {value}"
            raise EndpointError(f"{what}: {reason(error)}; write endpoints like {DEFAULT_ENDPOINT}") from None
    return made


def settings(
    mode: Mode,  # robots are clients: a router forwards between clients, but not between two peers
    *,
    connect: Sequence[str] = (),  # routers: a client uses the first that answers, a router is linked with each
    listen: Sequence[str] = (),  # loopback endpoints; a client needs none
    name: str | None = None,  # shown by `./zenpark keys`
    lease_s: float = LEASE_S,  # silence after which the others consider this session dead [s]
    identity: str | None = None,  # name in the certificate, in a lab; `name` if left out
    rights: access_control.Rights | None = None,  # rights of all identities; a router of a lab needs them
) -> dict[str, object]:
    """Settings of every session: no multicast, no gossip, no shared memory, listening on loopback only.

    With a lab (`agents.network.lab`) both ends show certificates, and listening beyond loopback is allowed. Raises
    EndpointError if an endpoint is malformed, and LabError if the lab has no such identity. An endpoint to listen on
    that can be reached from outside this machine is an EndpointError without a lab, or if the lab's router has no
    rights to enforce.
    """
    for endpoint in (*connect, *listen):
        protocol, slash, address = endpoint.partition("/")
        if not (protocol and slash and address and endpoint.isprintable()):
            raise EndpointError(f"'{endpoint}' is not an endpoint: write it like {DEFAULT_ENDPOINT}")
        if why := protocol_refusal(lab.bare([endpoint])[0]):
            raise EndpointError(why)
    of_lab, folder = _of_lab([*connect, *listen], identity or name or "", bool(listen), rights)
    connect, listen = topology.bare(connect), topology.bare(listen)
    if folder is None:
        for endpoint in listen:
            check_loopback(endpoint)
    elif listen and rights is None:
        raise EndpointError(f"listening in the lab {folder} needs its access rights: name the experiment")
    made: dict[str, object] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        # Ctrl-C does not end a wait inside Zenoh: a client fails at once and tries again in Python. Others open without
        # waiting, and try to connect as long as they live.
        "connect/timeout_ms": 0 if mode == "client" else -1,
        "connect/exit_on_failure": mode == "client",
        "open/return_conditions/connect_scouted": mode == "client",
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": round(lease_s * 1000),
        # A client without its router tries them in the order of the list; a frozen one delays it by this time.
        "transport/unicast/open_timeout": round((NEXT_S if mode == "client" and len(connect) > 1 else OPEN_S) * 1000),
        "transport/unicast/accept_timeout": round(OPEN_S * 1000),
        "transport/shared_memory/enabled": False,
        **dict.fromkeys(_WAITS, round(BLOCKED_S * 1e6)),
        "queries_default_timeout": round(ASK_S * 1000),
        # Questions to it are read-only, but a router that is asked for its tables may stand still for good.
        "adminspace/enabled": folder is None,
    }
    if name is not None:
        made["metadata"] = {"name": name}
    return made | of_lab


def _of_lab(
    endpoints: Sequence[str], identity: str, listens: bool, rights: access_control.Rights | None
) -> tuple[dict[str, object], Path | None]:
    """Settings of the lab of some endpoints, and its folder; empty and None without one."""
    folder = lab.lab_of(endpoints)
    if folder is None:
        return {}, None
    settings = lab.settings(folder, identity, listens=listens)
    if rights is not None:
        known = lab.register(folder)
        if identity in known.identities and not known.identities[identity].hosts:
            raise lab.LabError(
                f"{identity} has a certificate for clients only, but in a mesh all listen: `./zenpark lab init` "
                f"with the file of the mesh makes such, or `./zenpark lab issue {folder} NAME --host ADDRESS`"
            )
        settings["access_control"] = access_control.rules(rights, known)
        settings["low_pass_filter"] = access_control.sizes(rights)
        settings["transport/link/rx/max_message_size"] = MOST_BYTES
    return settings, folder


def check_loopback(endpoint: str) -> None:
    """Refuses, by EndpointError, to listen beyond loopback: without a lab there is no authentication."""
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
            f"will not listen on {endpoint}: any program there could command the robots. Make certificates with "
            "`./zenpark lab init LAB FILE`, then listen on tls/... with --lab LAB; or listen on "
            f"{DEFAULT_ENDPOINT} and let other machines in through an SSH tunnel (ssh -R 7447:127.0.0.1:7447 HOST)"
        )


def reason(error: zenoh.ZError) -> str:
    """The innermost reason in an error message of Zenoh, without the place in its source."""
    return str(error).partition(" at /")[0].rpartition(": ")[2]
