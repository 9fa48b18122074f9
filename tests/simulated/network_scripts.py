"""Scripts of what happens to routers and clients: what was guessed before they were played, and what is seen."""

from __future__ import annotations

from typing import Any, Final

from tests.simulated.conformance import Script

Steps = list[tuple[Any, ...]]
JOINED: Final[Steps] = [
    (0.0, "b", "open"), (0.1, "b", "watch", "t/*"), (0.2, "b", "subscribe_advanced", "v/*", 1),
    (0.3, "a", "open"), (0.4, "a", "advanced", "v/a", 1), (0.5, "a", "token", "t/a"), (0.6, "a", "put", "v/a", "1"),
]  # fmt: skip
ALONE: Final[Steps] = [(0.0, "a", "open"), (0.0, "b", "open")]

SCRIPTS: Final[dict[str, Script]] = {
    "a cut shorter than the lease": Script(
        "no token changes; the value that was put meanwhile arrives when the cable is back",
        [*JOINED, (1.0, "a", "cut"), (1.1, "a", "put", "v/a", "2"), (1.5, "a", "mend")],
        2.5,
    ),
    "a cut longer than the lease": Script(
        "the token vanishes 1.2 s after the cut, and is back with the last value at once when the cable is",
        [*JOINED, (1.0, "a", "cut"), (1.5, "a", "put", "v/a", "2"), (3.6, "a", "mend")],
        4.0,
        quick=True,
    ),
    "the observer is cut off": Script(
        "it loses the token after the 2 s of the router, and has token and last value again after the cut",
        [*JOINED, (1.0, "b", "cut"), (1.5, "a", "put", "v/a", "2"), (5.0, "b", "mend")],
        6.0,
    ),
    "a client is frozen for a moment": Script(
        "nothing changes",
        [*JOINED, (1.0, "a", "freeze"), (1.5, "a", "thaw"), (1.7, "a", "put", "v/a", "2")],
        2.5,
    ),
    "a client is frozen": Script(
        "its token vanishes after 1.2 s; after that it notices the end of its link at once and comes back",
        [*JOINED, (1.0, "a", "freeze"), (2.8, "a", "thaw"), (3.6, "a", "put", "v/a", "2")],
        4.0,
        quick=True,
    ),
    "the observer is frozen": Script(
        "it sees the token vanish and come back, and the value that was put while it was frozen",
        [*JOINED, (1.0, "b", "freeze"), (1.5, "a", "put", "v/a", "2"), (4.5, "b", "thaw")],
        6.0,
    ),
    "the router is frozen for a moment": Script(
        "nothing changes; values are late",
        [*JOINED, (1.0, "router", "freeze"), (1.2, "a", "put", "v/a", "2"), (1.5, "router", "thaw")],
        2.5,
    ),
    "the router is frozen": Script(
        "clients close their links after 2 s, and are back as soon as it goes on",
        [*JOINED, (1.0, "router", "freeze"), (1.5, "a", "put", "v/a", "2"), (4.6, "router", "thaw")],
        6.0,
    ),
    "a client is killed": Script("its token vanishes at once", [*JOINED, (1.0, "a", "kill")], 2.0),
    "a client leaves": Script("its token vanishes at once", [*JOINED, (1.0, "a", "close")], 2.0),
    "the router is killed and started again": Script(
        "tokens vanish at once, and are back within half a second, with the value that was put meanwhile",
        [*JOINED, (1.0, "router", "kill"), (1.3, "a", "put", "v/a", "2"), (2.0, "router", "start")],
        4.0,
        quick=True,
    ),
    "a client joins late": Script(
        "it has the last value of `a`, and of `c` the three that it keeps",
        [
            (0.0, "a", "open"), (0.0, "c", "open"), (0.1, "a", "advanced", "v/a", 1), (0.1, "c", "advanced", "w/c", 3),
            (0.3, "a", "put", "v/a", "1", "2", "3"), (0.3, "c", "put", "w/c", "1", "2", "3", "4"),
            (1.0, "b", "open"), (1.1, "b", "subscribe_advanced", "v/*", 1), (1.1, "b", "subscribe_advanced", "w/*", 3),
            (1.8, "c", "put", "w/c", "5"),
        ],
        2.6,
    ),
    "a ring overflows": Script(
        "the newest three are left",
        [
            *ALONE, (0.1, "b", "subscribe_ring", "v/*", 3), (0.3, "a", "publisher", "v/a"),
            (0.5, "a", "put", "v/a", *"123456789"), (1.5, "b", "drain", "v/*"),
        ],
        1.7,
    ),
    "a publisher repeats its number": Script(
        "an advanced subscriber has the first one, a plain one has all",
        [
            *ALONE, (0.1, "b", "subscribe_advanced", "v/*", 1), (0.1, "b", "subscribe_ring", "v/*", 9),
            (0.5, "a", "publisher", "v/a"), (0.7, "a", "put_numbered", "v/a", 5, *"1234"), (1.7, "b", "drain", "v/*"),
        ],
        1.9,
    ),
    "a token is withdrawn and declared": Script(
        "each change is seen, and that one by a client which watches its own token",
        [
            *JOINED, (0.8, "a", "watch", "t/*"), (1.2, "a", "withdraw", "t/a"), (1.6, "a", "token", "t/a"),
            (2.0, "a", "withdraw", "t/a"),
        ],
        2.5,
    ),
    "two clients hold one token": Script(
        "it appears once, and vanishes with the second",
        [
            *JOINED, (0.7, "c", "open"), (0.8, "a", "watch", "t/*"), (0.9, "c", "token", "t/a"),
            (1.3, "c", "withdraw", "t/a"), (1.6, "c", "token", "t/a"), (2.0, "a", "kill"),
            (2.5, "c", "withdraw", "t/a"),
        ],
        3.0,
    ),
    "a client holds one token twice": Script(
        "it appears once, and vanishes with the second",
        [*JOINED, (0.8, "a", "token", "t/a", "twin"), (1.2, "a", "withdraw", "t/a"), (1.6, "a", "withdraw", "twin")],
        2.0,
    ),
    "a client watches its own tokens without a router": Script(
        "they stay",
        [
            *JOINED, (0.75, "a", "watch", "t/*"), (1.0, "router", "kill"), (1.5, "a", "token", "t/z"),
            (2.0, "a", "withdraw", "t/a"), (2.5, "a", "token", "t/a"), (3.0, "router", "start"),
        ],
        5.0,
        seen="those that the router had vanish, and one that is withdrawn afterwards vanishes twice",
    ),
    "a client watches twice": Script(
        "the second watch has all tokens at once, even while the router is frozen",
        [
            *JOINED, (0.9, "b", "watch", "t/*"), (1.2, "router", "freeze"), (1.4, "b", "watch", "t/*"),
            (1.8, "router", "thaw"), (2.5, "a", "withdraw", "t/a"),
        ],
        3.0,
    ),
    "tokens are asked for": Script(
        "all are listed, those of the asker too; without an answer of the router there is an error alone",
        [
            *JOINED, (0.7, "b", "token", "t/b"), (0.7, "c", "open"), (0.8, "c", "token", "t/c"),
            # who watches the same keys does not ask: now and then Zenoh answers it nothing
            (1.1, "c", "ask_tokens", "t/*", 9.0), (1.4, "router", "freeze"), (1.5, "c", "ask_tokens", "t/*", 0.3),
            (2.1, "router", "thaw"), (2.8, "c", "ask_tokens", "t/*", 9.0),
        ],
        3.2,
        seen="before the error come tokens that the session knows: its own",
        quick=True,
        leases={"a": 9.0, "b": 9.0, "c": 9.0},  # a freeze that lasts longer on a busy machine ends no link
    ),
    "tokens are asked for without a router": Script(
        "the asker lists its own ones at once",
        [*JOINED, (0.7, "b", "token", "t/b"), (1.2, "router", "kill"), (1.7, "b", "ask_tokens", "t/*", 9.0)],
        2.5,
        seen="as guessed; but its own ones have vanished for its watch",
    ),
    "who is asked is killed": Script(
        "the question ends at once, without an answer",
        [*ALONE, (0.2, "a", "queryable", "q/a", None), (0.6, "b", "ask", "q/a", 9.0), (1.2, "a", "kill")],
        2.0,
    ),
    "who is asked is frozen": Script(
        "the question ends when the router closes the link, after 1.2 s",
        [*ALONE, (0.2, "a", "queryable", "q/a", "yes"), (0.6, "a", "freeze"), (0.8, "b", "ask", "q/a", 9.0)],
        3.0,
    ),
    "who asks is cut off": Script(
        "the question ends when the asker closes its link, 2 s after the cut, without an answer",
        [
            *ALONE, (0.2, "a", "queryable", "q/a", "yes"), (0.6, "b", "cut"), (0.8, "b", "ask", "q/a", 9.0),
            (4.0, "b", "mend"),
        ],
        5.0,
    ),
    "a question is answered too late": Script(
        "the asker has an error after its limit",
        [*ALONE, (0.2, "a", "queryable", "q/a", None), (0.6, "b", "ask", "q/a", 0.8)],
        2.0,
        seen="as guessed; now and then there are two errors, of the router as well",
    ),
    "two clients answer one question": Script(
        "both answers arrive; a question on a key without a queryable ends at once",
        [
            *ALONE, (0.0, "c", "open"), (0.2, "a", "queryable", "q/a", "yes"), (0.2, "c", "queryable", "q/*", "maybe"),
            (0.6, "b", "ask", "q/a", 9.0), (0.8, "b", "ask", "r/a", 9.0),
        ],
        1.5,
    ),
    "a client joins a frozen router": Script(
        "opening fails after 3 s; one that begins later succeeds when the router goes on",
        [*ALONE, (0.5, "router", "freeze"), (0.7, "c", "open"), (2.3, "d", "open"), (4.5, "router", "thaw")],
        5.0,
    ),
    "the first of two routers is killed": Script(
        "clients are on the second at once: the token vanishes and is back",
        [*JOINED, (1.0, "router", "kill"), (1.5, "a", "put", "v/a", "2"), (2.5, "b", "ask_tokens", "t/*", 9.0)],
        3.0,
        routers=2,
    ),
    "the first of two routers is frozen": Script(
        "after 2 s both go over, each attempt with the first one takes 1 s",
        [
            *JOINED, (1.0, "router", "freeze"), (1.5, "a", "put", "v/a", "2"), (5.5, "b", "ask_tokens", "t/*", 9.0),
            (6.5, "router", "thaw"), (7.5, "a", "put", "v/a", "3"),
        ],
        8.0,
        routers=2,
    ),
    "clients of two routers": Script(
        "a token and a value pass; when the first router is killed both are gone, and back when `a` is on the second",
        [
            (0.0, "b", "open", 1), (0.1, "b", "watch", "t/*"), (0.2, "b", "subscribe_advanced", "v/*", 1),
            *JOINED[3:], (1.2, "router", "kill"), (1.8, "a", "put", "v/a", "2"), (2.3, "b", "ask_tokens", "t/*", 9.0),
        ],
        3.0,
        routers=2,
    ),
    "the link of two routers is lost": Script(
        "a client of the other router sees the token vanish after 2 s, and come back when the frozen router goes on",
        [
            (0.0, "b", "open", 1), (0.1, "b", "watch", "t/*"), (0.2, "b", "subscribe_advanced", "v/*", 1),
            *JOINED[3:], (1.2, "router", "freeze"), (5.6, "router", "thaw"), (7.0, "a", "put", "v/a", "2"),
        ],
        8.0,
        routers=2,
    ),
    "the cable of two routers is cut": Script(
        "both sides lose the token of the other after 2 s; it is back with the last value as soon as the cable is",
        [
            (0.0, "b", "open", 1), (0.1, "b", "watch", "t/*"), (0.2, "b", "subscribe_advanced", "v/*", 1),
            *JOINED[3:], (0.7, "b", "token", "t/b"), (0.8, "a", "watch", "t/*"), (1.2, "router2", "cut"),
            (1.8, "a", "put", "v/a", "2"), (2.0, "b", "ask_tokens", "t/*", 9.0), (5.6, "router2", "mend"),
            (7.0, "a", "put", "v/a", "3"),
        ],
        8.0,
        routers=2,
    ),
    "the cable of two routers is cut shortly": Script(
        "no token changes; the value that was put meanwhile arrives when the cable is back",
        [
            (0.0, "b", "open", 1), (0.1, "b", "watch", "t/*"), (0.2, "b", "subscribe_advanced", "v/*", 1),
            *JOINED[3:], (1.2, "router2", "cut"), (1.5, "a", "put", "v/a", "2"), (2.2, "router2", "mend"),
        ],
        3.5,
        routers=2,
    ),
}  # fmt: skip
