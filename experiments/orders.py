"""Orders to robots, and to the world, from outside of them."""

from __future__ import annotations

from typing import Final

import zenoh

from agents import wire
from agents.keys import Keys

REPLY_S: Final = 1.0


def give(session: zenoh.Session, keys: Keys, robot: str, order: wire.Order, wait_s: float = REPLY_S) -> wire.Reply:
    """Gives an order to a robot and returns its reply; one that says no, and why, when the robot does not answer."""
    payload = wire.encode(order)
    reason = "no answer"
    for reply in session.get(keys.order(robot), payload=payload, encoding=wire.JSON, timeout=wait_s):
        if reply.ok is not None:
            try:
                return wire.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), wire.Reply)
            except wire.Malformed as error:
                reason = f"answered nonsense: {error}"
        elif reply.err is not None:
            reason = reply.err.payload.to_bytes().decode(errors="replace")
    return wire.Reply(robot, ok=False, phase="unknown", reason=reason)


def give_world(session: zenoh.Session, keys: Keys, order: wire.WorldOrder, wait_s: float = REPLY_S) -> wire.WorldReply:
    """Gives an order to the world and returns its reply; one that says no, and why, when it does not answer."""
    reason = "no world answers: is `zenpark world` running in this realm?"
    for reply in session.get(keys.world_order, payload=wire.encode(order), encoding=wire.JSON, timeout=wait_s):
        if reply.ok is not None:
            try:
                return wire.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), wire.WorldReply)
            except wire.Malformed as error:
                reason = f"it answered nonsense: {error}"
        elif reply.err is not None:
            reason = reply.err.payload.to_bytes().decode(errors="replace")
    return wire.WorldReply(ok=False, paused=False, time=0.0, reason=reason)
