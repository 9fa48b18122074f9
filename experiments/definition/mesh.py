"""Mesh without routers: the endpoint of every member, and which members connect to each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from agents.network import endpoints as topology
from agents.network import lab
from agents.network.access_control import Rights
from agents.network.endpoints import Endpoint, free_endpoint
from experiments.definition import access_rights
from experiments.definition.plan import Plan

ENDPOINTS: Final = "network.txt"  # file for --connect @FOLDER/network.txt, which looks at a run


def member_endpoints(cases: Iterable[Plan], *, secure: bool) -> list[str]:
    """Endpoints of all members of a mesh, each with its owner: robots, then support processes.

    All cases of a file have the same: a robot is at one place in all of them.

    Args:
        secure: Whether ports that are chosen ask for certificates.
    """
    found, services = dict[str, str](), ["recorder"]
    for plan in cases:
        case = plan.experiment
        for group in case.processes.values():
            given = next((case.network.addresses[name] for name in group if name in case.network.addresses), "")
            found.setdefault(topology.TOGETHER.join(group), given)
        services += ["world"] * access_rights.has_world(plan) + ["centre"] * bool(plan.guided)
        services += [case.capture.scheme] if case.capture and case.capture.simulated else []
    services = [*dict.fromkeys(services), "conductor"]
    taken = set(found.values())
    for name in (*found, *services):
        while not found.get(name):
            chosen = free_endpoint(0, "tls" if secure else "tcp")
            if chosen not in taken:
                found[name] = chosen
                taken.add(chosen)
    return [topology.owned(endpoint, name) for name, endpoint in found.items()]


def listening_hosts(plan: Plan) -> dict[str, list[str]]:
    """Host names at which the identities of a lab listen in a mesh; empty with routers."""
    experiment = plan.experiment
    if experiment.network.topology != "mesh":
        return {}
    here = ["localhost", "127.0.0.1", "::1"]
    given = experiment.network.addresses
    robots = {name: [Endpoint.parse(given[name]).host] if name in given else here for name in experiment.robots}
    return {**dict.fromkeys(("recorder", "world", "centre", "twin", "operator"), here), **robots}


def neighbour_endpoints(plan: Plan, names: Sequence[str], endpoints: Sequence[str]) -> list[str]:
    """Endpoints to which robots of one process connect, see `agents.network.endpoints`."""
    if not topology.is_mesh(endpoints):
        return list(endpoints)
    return topology.near(endpoints, access_rights.senders_by_receiver(plan), names)


def member_rights(plan: Plan, endpoints: Sequence[str]) -> Rights | None:
    """Rights that a member of a mesh enforces itself; None with routers, or without a lab."""
    if not topology.is_mesh(endpoints) or lab.lab_of(endpoints) is None:
        return None
    return access_rights.rights([plan])
