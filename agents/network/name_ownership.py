"""Ownership of a name on the network: a process commands others, or the body of a robot, only while it owns its name.

Robots, the world and the central controller have names. A process claims a name with a token that carries the time of
its start. Of several claims the earliest wins; a name that is owned already stays with its owner, whatever clocks say.
Tokens end with their session, so a name is free again as soon as its owner is dead, cut off, or suspended for longer
than its lease. In the last two cases its tokens come back, maybe after another process has taken the name. A process
that was cut off or suspended must check this (`OwnershipCheck`), and gives way to any other owner.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Final

import zenoh
from zenoh.handlers import Callback

from agents.clock import uptime
from agents.errors import ExplainedError
from agents.network import pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.zenoh_config import LEASE_S

ANSWER_S: Final = 10.0  # limit for the routers to answer
TURN_S: Final = 0.01  # pause between two polls of a check
SETTLE_S: Final = 0.2  # limit for a token to travel from one router to the next, and for a lost link to be noticed
TRIES: Final = 5  # questions until an answer is whole


@dataclass(frozen=True)
class OwnershipTiming:
    """Limits of the questions who owns a name [s]."""

    vanish_s: float = 2.5  # time for the tokens of a killed owner to vanish
    answer_s: float = ANSWER_S  # time for the routers to answer
    retry_s: float = network.RETRY_S  # pause between two questions


USUAL: Final = OwnershipTiming()


class NameTaken(ExplainedError):
    """A process of the same name is on the network already."""


def claim(
    session: zenoh.Session,
    alive: Sequence[str],  # liveliness key of each name
    *,
    began: float,  # start of the process, UTC [s]
    endpoints: Sequence[str] = (),  # routers; if there are several, tokens get `SETTLE_S` to travel between them
    stop: threading.Event | None = None,  # ends the wait when it is set
    timing: OwnershipTiming = USUAL,
) -> list[zenoh.LivelinessToken]:
    """Takes the ownership of names; returns the tokens that keep it, as long as they are referenced.

    The decision has two rounds, before and after the token of the owner is declared. Of two processes, the one with the
    later token at the router sees the other token in its round. Exactly one process passes both rounds.

    Raises NameTaken if another process owns one of the names, or claimed it earlier; the tokens of a killed process are
    given `vanish_s` to vanish. Raises network.Unreachable without an answer in `answer_s`, or when `stop` is set.
    """
    pause = stop or threading.Event()
    own_id = str(session.zid())
    rank = Keys.rank(began, own_id)

    def stands_in_the_way(key: str, token: str, owners: bool) -> bool:
        other = Keys.rank_of(key, token)
        return other < rank if other is not None else owners and token != Keys.life(key, own_id)

    def rivals(*, owners: bool) -> list[str]:
        """Names with an earlier claim, or with another owner if `owners` count."""
        deadline = time.monotonic() + timing.answer_s
        while True:
            asked = time.monotonic()
            found = {key: tokens_of(session, key) for key in alive}
            if time.monotonic() - asked > SETTLE_S:
                pause.wait(SETTLE_S)  # a link that is lost ends a question as an answer does, before that is noticed
            if pause.is_set():
                raise network.Unreachable("asked to end before the name was taken")
            if all(found.values()) and network.connected(session):  # the own claim is in each whole answer
                break
            if time.monotonic() > deadline:
                raise network.Unreachable(
                    f"no router answers who owns the name, for {timing.answer_s:g} s: is it overloaded?"
                )
            pause.wait(timing.retry_s)
        return [
            key for key, tokens in found.items() if any(stands_in_the_way(key, each, owners) for each in tokens or ())
        ]

    settle_s = SETTLE_S if len(endpoints) > 1 else 0.0
    tokens = [pubsub.alive_token(session, Keys.claim(key, rank)) for key in alive]
    try:
        pause.wait(settle_s)
        deadline = time.monotonic() + timing.vanish_s
        while others := rivals(owners=True):
            if time.monotonic() > deadline:
                raise NameTaken(", ".join(others))
            pause.wait(timing.retry_s)
        tokens += [pubsub.alive_token(session, Keys.life(key, own_id)) for key in alive]
        pause.wait(settle_s)
        if others := rivals(owners=False):
            raise NameTaken(", ".join(others))
    except BaseException:
        for token in tokens:
            token.undeclare()
        raise
    return tokens


def tokens_of(session: zenoh.Session, alive: str) -> set[str] | None:
    """Tokens of the owners of a name, and of those that claim it; None without an answer.

    A token of this session is in each whole answer. Zenoh 1.10 may answer nothing beside a watch of the same keys, as
    a process with two robots has: it is asked again at once. A link that is lost ends a question with nothing, too.
    """
    for _ in range(TRIES):
        tokens = network.tokens_present(session, Keys.lives(alive))
        if tokens or tokens is None:
            break
    return tokens


def confirm_ownership(
    session: zenoh.Session,
    alive: Sequence[str],
    pause: threading.Event,
    timing: OwnershipTiming = USUAL,
    note: Callable[[bool], object] = lambda _: None,  # called with each answer: whether there is another owner
) -> None:
    """Returns when it is certain that no other process has taken the names since they were owned.

    One answer is not enough: a link that is lost ends its questions as an answer does, and a process that takes the
    name may be between its two rounds. No other owner must be seen for `SETTLE_S`. One that is seen may still give way
    to the claim of this process, for `vanish_s`, also while no answer comes any more. `pause` ends the wait when it is
    set. The tokens of the session are declared; Zenoh declares them again after it was cut off.

    Raises NameTaken if another process owns one of the names, and network.Unreachable if `pause` was set before that
    was known; without a router the wait has no limit.
    """
    own_id = str(session.zid())
    free = taken = inf
    others: list[str] = []
    while not pause.is_set():
        linked = network.connected(session)
        found = [tokens_of(session, key) for key in alive]
        now = time.monotonic()
        if not linked or None in found or not network.connected(session):
            free = inf
        elif named := [
            key
            for key, tokens in zip(alive, found, strict=True)
            if any(Keys.life_of(token) not in (None, own_id) for token in tokens or ())
        ]:
            others = named
            free, taken = inf, min(taken, now)
            note(True)
        elif not all(found):  # an owner that was seen may still be there
            free = inf
        else:
            free, taken = min(free, now), inf
            note(False)
            if now - free > SETTLE_S:
                return
        if now - taken > timing.vanish_s:
            raise NameTaken(", ".join(others))
        pause.wait(timing.retry_s)
    raise network.Unreachable("asked to end before it was known whether the name has another owner")


def rivals(alive: str, session: str, tokens: Iterable[str]) -> tuple[list[str], bool]:
    """Sessions that own a name beside `session` and claimed it later, and whether an earlier owner objects to that one.

    `tokens` are all below the liveliness key `alive`.
    """
    standing = set(tokens)
    claims = sorted((each for each in standing if Keys.rank_of(alive, each) is not None), reverse=True)
    claim = {Keys.session_of(each): each for each in claims}  # the earliest of each: an objection is later
    if session not in claim:
        return [], False
    others = [each for each in claim if each != session and each and Keys.life(alive, each) in standing]
    later = [each for each in others if claim[each] > claim[session]]
    objected = any(Keys.objection(alive, each, session) in standing for each in others if each not in later)
    return later, objected


class OwnershipCheck:
    """Check whether a process still owns its names, in a thread of its own: a loop polls the result.

    When a network that was split heals, a name may have two owners that never lost their routers. Each sees the token
    of the other; the one with the earlier claim objects, and the other one gives way to the objection. A process that
    was away does not object: the other one has taken a name that was free.
    """

    def __init__(self, alive: Sequence[str], lease_s: float = LEASE_S, timing: OwnershipTiming = USUAL) -> None:
        """Begin when the names are owned: liveliness keys `alive`, in a session with the lease `lease_s` [s]."""
        self._alive, self._stood_s = alive, 0.5 * lease_s
        self._timing = timing
        self.awake_at = uptime()  # last run of the process [s]
        self.linked = True  # whether the session had a router, or a neighbour in a mesh, at the last look
        self._lost = False  # True if it had none, at any time since a look at which it was linked
        self._away = False  # True from a standstill, or a return, until its check begins
        self._neighbours: set[str] = set()  # routers, or neighbours in a mesh, by their ids
        self._listener: zenoh.TransportEventsListener[None] | None = None
        self._watches: list[zenoh.Subscriber[None]] = []
        self._tokens: set[str] = set()  # tokens below the names
        self._objections: dict[str, zenoh.LivelinessToken | None] = {}
        self.contested = False  # True if the last answer named another owner, which may still give way
        self._taken = ""
        self._asking: threading.Thread | None = None
        self._anew = False
        self._over = threading.Event()

    def begin(self, session: zenoh.Session) -> None:
        """Starts a check; a running one is repeated afterwards."""
        self._session, self._anew = session, self._asking is not None
        if self._asking is None:
            self._asking = threading.Thread(target=self._ask, name="owner of the name", daemon=True)
            self._asking.start()
        self._away = False  # not before: a process that was away does not object

    def finished(self) -> bool:
        """Whether no check runs (0.1 µs then); raises NameTaken, each time, if another process owns a name."""
        if self._asking is not None and not self._asking.is_alive():
            self._asking = None
            if self._anew and not self._taken:
                self.begin(self._session)
        if self._taken:
            raise NameTaken(self._taken)
        return self._asking is None

    def note_run(self) -> None:
        """Notes that the process runs now."""
        self.awake_at = uptime()

    def check_standstill(self) -> bool:
        """Whether the process stood still since the last call for longer than its names are safe."""
        now = uptime()
        stood = now - self.awake_at >= self._stood_s
        self._away |= stood
        self.awake_at = now
        return stood

    def check_return(self, session: zenoh.Session) -> bool:
        """Whether the session is linked again after it was not: the names may be lost since.

        A check has to begin then. A link that was cut for longer than the lease of this end is closed and opened again
        within milliseconds of its return, thus between two looks.
        """
        if self._listener is None:
            callback = Callback(self._follow_links, indirect=False)
            self._listener = session.info.declare_transport_events_listener(callback, history=True)
            self._session = session
            follow = Callback(self._follow_tokens, indirect=False)
            self._watches = [
                session.liveliness().declare_subscriber(Keys.lives(key), follow, history=True) for key in self._alive
            ]
        if self._lost or not self._neighbours:  # else the last event was that of a link
            self.linked = network.connected(session)
            self._lost |= not self.linked
        if back := self._lost and self.linked:
            self._away = True
            self._lost = False
        return back

    def is_contested(self, session: zenoh.Session) -> bool:
        """As `contested`; a check begins if the session is linked again. Calls nothing of Zenoh, which may hang."""
        if self._lost and self._neighbours:
            self._lost = False
            self.begin(session)
        return self.contested or bool(self._taken)

    def wait_while_checking(self, session: zenoh.Session, ended: Callable[[], bool]) -> bool:
        """Wait while a check runs; one begins if the process stood still since the last call, or was cut off until now.

        For processes without a body, before they send anything: another process may send the same meanwhile. Returns
        whether it waited. Raises NameTaken as `finished`.
        """
        stood, back = self.check_standstill(), self.check_return(session)
        if stood or back:
            self.begin(session)
        waited = False
        while not self.finished() and not ended():
            waited = True
            time.sleep(TURN_S)
            self.note_run()
        return waited

    def end(self) -> None:
        self._over.set()

    def _follow_links(self, event: zenoh.TransportEvent) -> None:
        """Notes the loss of the last link, in the receiving thread."""
        if event.kind == zenoh.SampleKind.PUT:
            self._neighbours.add(str(event.transport.zid))
        else:
            self._neighbours.discard(str(event.transport.zid))
            self._lost |= not self._neighbours

    def _follow_tokens(self, sample: zenoh.Sample) -> None:
        """Settles the case of a name with two owners, in the receiving thread."""
        token = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT:
            self._tokens.discard(token)
            return
        self._tokens.add(token)
        own_id = str(self._session.zid())
        for key in self._alive:
            later, objected = rivals(key, own_id, self._tokens)
            if objected:
                self._taken = key
            elif later and (self._asking is not None or uptime() - self.awake_at >= self._stood_s):
                self._lost = True  # it was away
            elif not (self._lost or self._away):
                self._object([Keys.objection(key, own_id, each) for each in later])

    def _object(self, objections: Sequence[str]) -> None:
        def declare() -> None:
            with suppress(zenoh.ZError):  # the session is closed
                self._objections.update({each: pubsub.alive_token(self._session, each) for each in new})

        if new := [each for each in objections if each not in self._objections]:
            self._objections.update(dict.fromkeys(new))
            threading.Thread(target=declare, name="objection", daemon=True).start()  # none is declared in a callback

    def _note(self, contested: bool) -> None:
        self.contested = contested

    def _ask(self) -> None:
        try:
            confirm_ownership(self._session, self._alive, self._over, self._timing, self._note)
        except NameTaken as taken:
            self._taken = str(taken)
        except network.Unreachable:
            pass  # `end` was called


class NameKeeper:
    """Names of the robots of one process: their claim, the check after a standstill, and their tokens.

    The token of a robot shows its neighbours that it is alive and takes part. The watchdog withdraws tokens, too, in a
    thread of its own.
    """

    def __init__(self, keys: Keys, names: Sequence[str], began: float, timing: OwnershipTiming = USUAL) -> None:
        """Names of a process that began at `began`, UTC [s]."""
        self.hands_off = False  # another process drives the bodies, or may do so
        self._keys, self._names, self._began, self._timing = keys, names, began, timing
        self.ownership = OwnershipCheck([keys.alive(name) for name in names], network.ROBOT_LEASE_S, timing)
        self._owned: list[zenoh.LivelinessToken] = []
        self._tokens: dict[int, zenoh.LivelinessToken] = {}  # tokens by row
        self._lock = threading.Lock()

    def claim(self, session: zenoh.Session, endpoints: Sequence[str], stop: threading.Event) -> None:
        """Claims the names, before any body is touched; raises NameTaken and network.Unreachable as `claim`."""
        alive = [self._keys.alive(name) for name in self._names]
        try:
            self._owned = claim(session, alive, began=self._began, endpoints=endpoints, stop=stop, timing=self._timing)
            self.ownership.note_run()
            self.ownership.check_return(session)
        except NameTaken as taken:
            raise NameTaken(
                f"{self._owners_text(taken)}: a robot of this name is on the network already; end it first "
                "(`./zenpark keys` lists its members), or choose another router with --connect"
            ) from None

    def is_owner(self) -> bool:
        """Whether the names belong to this process; False while a check runs.

        Raises NameTaken if they belong to another one; the bodies are that one's then.
        """
        try:
            return self.ownership.finished()
        except NameTaken as taken:
            self.hands_off = True
            raise NameTaken(
                f"{self._owners_text(taken)}: another process has taken this name while this one stood still or was "
                "cut off, or had it before on another side of a split network; it leaves, and its body to the other one"
            ) from None

    def declare(self, session: zenoh.Session, rows: Iterable[int]) -> None:
        """Declares the tokens of those rows that have none."""
        with self._lock:
            for row in rows:
                if row not in self._tokens:
                    self._tokens[row] = pubsub.alive_token(session, self._keys.alive(self._names[row]))

    def withdraw(self, rows: Iterable[int], only_if: Callable[[], bool] = lambda: True) -> None:
        """Undeclares the tokens of these rows, if `only_if` is true when no other thread touches them."""
        with self._lock:
            tokens = [self._tokens.pop(row) for row in rows if row in self._tokens] if only_if() else []
        for token in tokens:
            token.undeclare()

    def _owners_text(self, taken: NameTaken) -> str:
        return ", ".join(self._keys.robot_of(token) or token for token in str(taken).split(", "))
