"""`zenpark world-order`: tells a running world what to do, by hand."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from agents import session as network
from agents import wire
from agents.endpoint import DEFAULT_ENDPOINT
from agents.keys import Keys
from agents.plugins import did_you_mean
from experiments import json_text, orders
from twins.scene import Obstacle

KINDS = ("pause", "resume", "step", "reset", "spawn", "remove")


class WorldOrderError(ValueError):
    """An order that makes no sense as it was written, with how to write it."""


def command(
    what: str,
    name: str | None,
    *,
    steps: int,
    kind: str | None,
    at: tuple[float, float] | None,
    yaw: float,
    obstacle: str | None,
    connect: Sequence[str],
    realm: str,
    identity: str = "operator",
) -> int:
    """Gives an order to the world and prints its reply.

    Returns:
        The exit code: 0, or 1 if it refused.

    Raises:
        WorldOrderError: If there is no such order, or what is put in has no place.
        DocumentError: If the obstacle is none.
        EndpointError, Unreachable: If no router can be reached.
    """
    if what not in KINDS:
        raise WorldOrderError(f"no order '{what}' to a world; {did_you_mean(what, KINDS)}")
    given = None
    if obstacle is not None:
        given = json_text.table("--obstacle", obstacle, Obstacle, ("arena", "obstacles", name or "it"))
        if at is not None:
            given["at"] = at
        if what == "spawn" and not given.keys() & {"at", "wall"}:
            raise WorldOrderError(f"{name or 'the obstacle'} has no place; say where, with --at X Y")
    order = wire.WorldOrder(what, steps=steps, name=name, kind=kind, at=at, yaw=yaw, obstacle=given)  # type: ignore[arg-type]
    with network.open_session(
        list(connect) or [DEFAULT_ENDPOINT], name="world-order", wait_s=2.0, identity=identity
    ) as session:
        reply = orders.give_world(session, Keys(realm), order)
    if not reply.ok:
        print(f"no: {reply.reason}", file=sys.stderr)
        return 1
    print(f"{done(order)}; the world {'stands still' if reply.paused else 'runs'} at {reply.time:.2f} s")
    return 0


def done(order: wire.WorldOrder) -> str:
    """What a world did that obeyed."""
    match order.order:
        case "pause":
            return "paused"
        case "resume":
            return "goes on"
        case "step":
            return f"makes {order.steps} tick{'s' * (order.steps != 1)}"
        case "reset":
            return f"{order.name} is back at its start" if order.name else "all are back at their starts"
        case "remove":
            return f"{order.name} is out"
    what = order.name if order.kind is None else f"{order.name}, a {order.kind},"
    where = "" if order.at is None else f" at x = {order.at[0]:g} m, y = {order.at[1]:g} m"
    return f"{what} is in{where}"
