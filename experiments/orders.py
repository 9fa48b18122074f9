"""Orders to robots, to the world and to the conductor of a run, from outside of them."""

from __future__ import annotations

from typing import Final, TypeVar

import zenoh

from agents import wire
from agents.keys import Keys

REPLY_S: Final = 1.0
CHANGE_S: Final = 90.0  # a robot lands, its process ends, another starts, is ready, and climbs

R = TypeVar("R", wire.Reply, wire.WorldReply, wire.RunReply)


def give(session: zenoh.Session, keys: Keys, robot: str, order: wire.Order, wait_s: float = REPLY_S) -> wire.Reply:
    """Gives an order to a robot and returns its reply; one that says no, and why, when the robot does not answer."""
    reply, why = _ask(session, keys.order(robot), wire.encode(order), wire.Reply, wait_s)
    return reply or wire.Reply(robot, ok=False, phase="unknown", reason=why or "no answer")


def give_world(session: zenoh.Session, keys: Keys, order: wire.WorldOrder, wait_s: float = REPLY_S) -> wire.WorldReply:
    """Gives an order to the world and returns its reply; one that says no, and why, when it does not answer."""
    reply, why = _ask(session, keys.world_order, wire.encode(order), wire.WorldReply, wait_s)
    nobody = "no world answers: is `zenpark world` running in this realm?"
    return reply or wire.WorldReply(ok=False, paused=False, time=0.0, reason=why or nobody)


def give_run(session: zenoh.Session, keys: Keys, order: wire.RunOrder, wait_s: float = CHANGE_S) -> wire.RunReply:
    """Gives an order to the conductor and returns its reply when all is done, or that no conductor answers."""
    reply, why = _ask(session, keys.run_order, wire.encode(order), wire.RunReply, wait_s)
    nobody = (
        "no conductor answers: is `zenpark run` running in this realm, at this router (--connect), and is this an "
        "operator (--as)?"
    )
    return reply or wire.RunReply(reason=why or nobody)


def _ask(session: zenoh.Session, key: str, payload: bytes, kind: type[R], wait_s: float) -> tuple[R | None, str]:
    """The reply, or why there is none; empty if nobody said anything."""
    why = ""
    for reply in session.get(key, payload=payload, encoding=wire.JSON, timeout=wait_s):
        if reply.ok is not None:
            try:
                return wire.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), kind), ""
            except wire.Malformed as error:
                why = f"it answered nonsense: {error}"
        elif reply.err is not None:
            why = reply.err.payload.to_bytes().decode(errors="replace")
    return None, why
