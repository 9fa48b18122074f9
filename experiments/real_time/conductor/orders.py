"""Orders to robots, to the world and to the conductor of a run, from outside of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, TypeVar

import zenoh

from agents.network import messages
from agents.network.keys import Keys

REPLY_S: Final = 1.0
LEAD_S: Final = 0.5  # from the order to the common start: every robot has it by then,
LEAD_EACH_S: Final = 0.01  # with so much more for each robot
CHANGE_S: Final = 90.0  # a robot lands, its process ends, another starts, is ready, and climbs

R = TypeVar("R", messages.Reply, messages.WorldReply, messages.RunReply)


def start_lead_s(robots: int) -> float:
    """How far ahead of the order a common start of so many robots lies [s]."""
    return LEAD_S + LEAD_EACH_S * robots


def send_order(
    session: zenoh.Session, keys: Keys, robots: Sequence[str], order: messages.Order, wait_s: float = REPLY_S
) -> dict[str, messages.Reply]:
    """Give an order to robots, to all at once, and return their replies; a refusal, with why, for one that is silent.

    A robot that hangs costs the others no time: each has the order before the first answer is waited for.
    """
    payload = messages.encode(order)
    asked = {robot: session.get(keys.order(robot), payload=payload, encoding=messages.JSON, timeout=wait_s)
             for robot in robots}  # fmt: skip
    replies = {}
    for robot, answers in asked.items():
        reply, why = _read(answers, messages.Reply)
        replies[robot] = reply or messages.Reply(robot, ok=False, phase="unknown", reason=why or "no answer")
    return replies


def send_world_order(
    session: zenoh.Session, keys: Keys, order: messages.WorldOrder, wait_s: float = REPLY_S
) -> messages.WorldReply:
    """Give an order to the world and return its reply; one that says no, and why, when it does not answer."""
    asked = session.get(keys.world_order, payload=messages.encode(order), encoding=messages.JSON, timeout=wait_s)
    reply, why = _read(asked, messages.WorldReply)
    nobody = "no world answers: is `zenpark world` running in this realm?"
    return reply or messages.WorldReply(ok=False, paused=False, time=0.0, reason=why or nobody)


def send_run_order(
    session: zenoh.Session, keys: Keys, order: messages.RunOrder, wait_s: float = CHANGE_S
) -> messages.RunReply:
    """Give an order to the conductor and return its reply when all is done, or that no conductor answers."""
    asked = session.get(keys.run_order, payload=messages.encode(order), encoding=messages.JSON, timeout=wait_s)
    reply, why = _read(asked, messages.RunReply)
    nobody = (
        "no conductor answers: is `zenpark run` running in this realm, at this router (--connect), and is this an "
        "operator (--as)?"
    )
    return reply or messages.RunReply(reason=why or nobody)


def _read(asked: Iterable[zenoh.Reply], kind: type[R]) -> tuple[R | None, str]:
    """The reply, or why there is none; empty if nobody said anything."""
    why = ""
    for reply in asked:
        if reply.ok is not None:
            try:
                return messages.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), kind), ""
            except messages.Malformed as error:
                why = f"it answered nonsense: {error}"
        elif reply.err is not None:
            why = reply.err.payload.to_bytes().decode(errors="replace")
    return None, why
