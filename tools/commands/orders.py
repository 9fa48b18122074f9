"""`zenpark world-order`: tells a running world what to do, by hand."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import get_args

from agents.network import messages
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.plugins.registry import did_you_mean
from experiments.file import structure
from experiments.real_time.conductor import orders
from tools.commands.network import printable
from twins.scene import Obstacle

KINDS = ("pause", "resume", "step", "reset", "spawn", "remove")


class WorldOrderError(ValueError):
    """An order that makes no sense as it was written, with how to write it."""


def world_order(
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
        given = structure.table("--obstacle", obstacle, Obstacle, ("arena", "obstacles", name or "it"))
        if at is not None:
            given["at"] = at
        if what == "spawn" and not given.keys() & {"at", "wall"}:
            raise WorldOrderError(f"{name or 'the obstacle'} has no place; say where, with --at X Y")
    order = messages.WorldOrder(what, steps=steps, name=name, kind=kind, at=at, yaw=yaw, obstacle=given)  # type: ignore[arg-type]
    with network.open_session(
        list(connect) or [DEFAULT_ENDPOINT], name="world-order", wait_s=2.0, identity=identity
    ) as session:
        reply = orders.give_world(session, Keys(realm), order)
    if not reply.ok:
        print(f"no: {reply.reason}", file=sys.stderr)
        return 1
    print(f"{done(order)}; the world {'stands still' if reply.paused else 'runs'} at {reply.time:.2f} s")
    return 0


def done(order: messages.WorldOrder) -> str:
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


def robot_order(
    what: messages.ChangeKind,
    names: Sequence[str],
    *,
    connect: Sequence[str],
    realm: str,
    identity: str,
    spare: str | None = None,
    body: str | None = None,
    at: tuple[float, float] | None = None,
    yaw: float = 0.0,
) -> int:
    """Gives an order to the conductor, waits until it is done, and prints what became of each robot.

    Returns:
        The exit code: 0, 1 if something was refused, 2 if the whole order was.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    order = messages.RunOrder(what, list(names), who=identity, spare=spare, body=body, at=at, yaw=yaw)
    with network.open_session(
        list(connect) or [DEFAULT_ENDPOINT], name="zenpark robot", wait_s=2.0, identity=identity
    ) as session:
        reply = orders.give_run(session, Keys(realm), order)
    if reply.reason:
        print(f"zenpark: {printable(reply.reason)}", file=sys.stderr)
        return 2
    for name, text in reply.done.items():
        print(f"{printable(name)}: {printable(text)}")
    for name, text in reply.refused.items():
        print(f"{printable(name)}: no: {printable(text)}", file=sys.stderr)
    return 1 if reply.refused else 0


def order_by_hand(
    what: str, robots: Sequence[str], *, connect: Sequence[str], realm: str, identity: str = "operator"
) -> int:
    """Gives an order to robots, to all that are there if none is named, and prints their replies.

    Returns:
        The exit code: 0, or 1 if one refused.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    kinds = [kind for kind in get_args(messages.OrderKind) if kind not in ("get", "set")]
    if what not in kinds:
        print(f"zenpark: no order '{what}'; there are: {', '.join(kinds)}", file=sys.stderr)
        return 2
    keys = Keys(realm)
    with network.open_session(
        list(connect) or [DEFAULT_ENDPOINT], name="order", wait_s=2.0, identity=identity
    ) as session:
        there = [
            robot
            for reply in session.liveliness().get(keys.alive("*"), timeout=2.0)
            if reply.ok is not None and (robot := keys.whose(str(reply.ok.key_expr))) is not None
        ]
        if not there:
            print(f"zenpark: no robot is there in the realm '{realm}'; `zenpark keys` shows who is", file=sys.stderr)
            return 2
        told = list(robots) or sorted(there)
        at = time.time() + orders.lead(len(told)) if what == "start" else None
        refused = False
        order = messages.Order(what, at=at)  # type: ignore[arg-type]
        for robot, reply in orders.give(session, keys, told, order).items():
            refused |= not reply.ok
            print(
                f"{robot}: {'yes' if reply.ok else 'no'}, {reply.phase}" + (f": {reply.reason}" if reply.reason else "")
            )
    return 1 if refused else 0
