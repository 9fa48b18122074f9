"""`zenpark order`: tells robots what to do, by hand."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import get_args

from agents import session as network
from agents import wire
from agents.endpoint import DEFAULT_ENDPOINT
from agents.keys import Keys
from experiments import orders


def command(what: str, robots: Sequence[str], *, connect: Sequence[str], realm: str, identity: str = "operator") -> int:
    """Gives an order to robots, to all that are there if none is named, and prints their replies.

    Returns:
        The exit code: 0, or 1 if one refused.

    Raises:
        EndpointError, Unreachable: If no router can be reached.
    """
    kinds = [kind for kind in get_args(wire.OrderKind) if kind not in ("get", "set")]
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
        order = wire.Order(what, at=at)  # type: ignore[arg-type]
        for robot, reply in orders.give(session, keys, told, order).items():
            refused |= not reply.ok
            print(
                f"{robot}: {'yes' if reply.ok else 'no'}, {reply.phase}" + (f": {reply.reason}" if reply.reason else "")
            )
    return 1 if refused else 0
