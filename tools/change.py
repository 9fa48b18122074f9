"""`zenpark robot ...`: asks the conductor of a run for a change, and says what came of it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from agents import session as network
from agents import wire
from agents.endpoint import DEFAULT_ENDPOINT
from agents.keys import Keys
from experiments import orders
from tools.network import printable


def command(
    what: wire.ChangeKind,
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
    order = wire.RunOrder(what, list(names), who=identity, spare=spare, body=body, at=at, yaw=yaw)
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
