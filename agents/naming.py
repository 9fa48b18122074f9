"""Ownership of a name on the network: a process touches the body of a robot only while it owns the robot's name.

A process claims a name with a token that carries the time of its start. Of several claims the earliest wins; a name
that is owned already stays with its owner, whatever clocks say. Tokens end with their session, so a name is free again
as soon as its owner is dead.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Final

import zenoh

from agents import session as network
from agents.keys import Keys

GHOST_S: Final = 2.5  # limit for the tokens of a killed owner to vanish
ANSWER_S: Final = 10.0  # limit for the routers to answer
SETTLE_S: Final = 0.2  # limit for a token to travel from one router to the next


class NameTaken(RuntimeError):
    """A process of the same name is on the network already."""


def claim(
    session: zenoh.Session,
    alive: Sequence[str],
    *,
    began: float,
    endpoints: Sequence[str] = (),
    stop: threading.Event | None = None,
) -> list[zenoh.LivelinessToken]:
    """Takes the ownership of names; returns the tokens that keep it, as long as they are referenced.

    The decision has two rounds, before and after the token of the owner is declared. Of two processes, the one whose
    token a router got later sees the other one's in its round, so that exactly one passes both.

    Args:
        session: Of the process.
        alive: Liveliness key of each name.
        began: Start of the process, UTC [s].
        endpoints: Routers; if there are several, tokens get `SETTLE_S` to travel between them.
        stop: Ends the wait when it is set.

    Raises:
        NameTaken: If another process owns one of the names, or claimed it earlier; the tokens of a killed process are
            given `GHOST_S` to vanish.
        network.Unreachable: If no router answers within `ANSWER_S`, or `stop` was set.
    """
    pause = stop or threading.Event()
    mine = str(session.zid())
    rank = Keys.rank(began, mine)
    settle_s = SETTLE_S if len(endpoints) > 1 else 0.0
    tokens = [network.alive_token(session, Keys.claim(key, rank)) for key in alive]
    try:
        pause.wait(settle_s)
        _first_round(session, alive, mine, rank, pause)
        tokens += [network.alive_token(session, Keys.life(key, mine)) for key in alive]
        pause.wait(settle_s)
        others = _others(session, alive, mine, rank, pause, owners=False)
        if others:
            raise NameTaken(", ".join(others))
    except BaseException:
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
        raise
    return tokens


def _first_round(session: zenoh.Session, alive: Sequence[str], mine: str, rank: str, pause: threading.Event) -> None:
    """Waits until no other process owns a name or has an earlier claim."""
    deadline = time.monotonic() + GHOST_S
    while others := _others(session, alive, mine, rank, pause, owners=True):
        if time.monotonic() > deadline:
            raise NameTaken(", ".join(others))
        pause.wait(network.RETRY_S)


def _others(
    session: zenoh.Session, alive: Sequence[str], mine: str, rank: str, pause: threading.Event, *, owners: bool
) -> list[str]:
    """Names (their liveliness keys) with an earlier claim than `rank`, or with another owner if `owners` count."""
    deadline = time.monotonic() + ANSWER_S
    while True:
        found = {key: network.here(session, Keys.lives(key)) for key in alive}
        if pause.is_set():
            raise network.Unreachable("told to end before the name was taken")
        if None not in found.values() and network.connected(session):
            break
        if time.monotonic() > deadline:
            raise network.Unreachable(f"no router answers who owns the name, for {ANSWER_S:g} s: is it overloaded?")
        pause.wait(network.RETRY_S)
    return [
        key for key, tokens in found.items() if any(_rival(key, token, mine, rank, owners) for token in tokens or ())
    ]


def _rival(alive: str, token: str, mine: str, rank: str, owners: bool) -> bool:
    """Whether a token stands in the way of the claim `rank` of the session `mine`."""
    if (other := Keys.rank_of(alive, token)) is not None:
        return other < rank
    return owners and token != Keys.life(alive, mine)
