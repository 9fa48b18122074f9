"""The router process: `python -m agents.runtime.router`.

Light to start, since every run on one machine starts one.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import msgspec
import zenoh
from msgspec import Meta
from zenoh.handlers import Callback

from agents.clock import Clock
from agents.errors import ExplainedError
from agents.network import lab, messages
from agents.network import session as network
from agents.network.access_control import Rights
from agents.network.endpoints import DEFAULT_ENDPOINT, EndpointError
from agents.network.keys import Keys
from agents.network.session import deserted, forbid_lingering, hang_up_on, tokens_present
from agents.network.shutdown import closing_cleanly, end
from agents.network.zenoh_config import config, reason, settings
from agents.runtime import command_line
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import GONE, Lifeline

EMPTY_S: Final = 1.0  # no client for this long: a client that lost its connection would be back
LOOK_S: Final = 0.1
PORT_FREE_S: Final = 10.0  # limit for the port of a router that restarts to become free
AGAIN_S: Final = 0.1
MOST_TOKENS: Final = 1000  # tokens of a robot: more slow the router down
MOST_SESSIONS: Final = 8  # sessions of a certificate: each that does not read delays an emergency stop by `BLOCKED_S`
STUCK_S: Final = 2.0  # limit for an answer of the router to itself
# Period of the checks for new connections, tokens, revoked certificates and signals: a signal that the kernel delivers
# to another thread, as after a SIGCONT, does not wake the waiting one.
LOOK_AGAIN_S: Final = 0.5


def serve(
    endpoints: Sequence[str],  # places to listen on: on loopback, or anywhere with a lab
    *,
    link: Sequence[str] = (),  # other routers, with which it shares all keys
    lifeline: bool = False,  # standard input is a lifeline
    linger_s: float = 0.0,  # time that it stays after its loss, for robots that land [s]; less without clients
    rights: Rights | None = None,  # rights of all identities, in a lab
) -> int:
    """Runs a router until SIGINT, SIGTERM or the loss of its lifeline; returns the exit code of the process.

    Prints one line when clients can connect. Raises as `serve_router`.
    """
    stop, lost = threading.Event(), threading.Event()
    rope = Lifeline(lost)

    def leave(sessions: Sequence[zenoh.Session]) -> None:
        lost.wait()
        over = time.monotonic() + linger_s
        empty = time.monotonic()
        while (now := time.monotonic()) < over and not stop.wait(LOOK_S):
            if not deserted(sessions[0]):
                empty = now
            elif now - empty > EMPTY_S:
                break
        stop.set()

    open_now: list[zenoh.Session] = []
    check = StuckCheck(lambda: _answers(open_now[0]))

    def ready(session: zenoh.Session) -> None:
        begun = bool(open_now)
        open_now[:] = [session]
        if begun:
            return
        print(f"router ready on {', '.join(endpoints)}", flush=True)
        check.start()
        if lifeline:
            rope.start()
            threading.Thread(target=leave, args=(open_now,), name="linger", daemon=True).start()

    with on_termination(stop.set):
        serve_router(endpoints, stop, link=link, ready=ready, rights=rights)
    check.end()
    if rope.reason is not None:
        print(f"router: {'ends with its starter' if rope.reason == GONE else rope.reason}", file=sys.stderr)
    return 0


def serve_router(
    endpoints: Sequence[str],
    stop: threading.Event,
    *,
    link: Sequence[str] = (),
    ready: Callable[[zenoh.Session], None] = lambda _: None,
    rights: Rights | None = None,
) -> None:
    """Runs a router on loopback endpoints, or on those of a lab, until `stop` is set.

    When the register of its lab changes, the router restarts with the new rules: revoked certificates have no rights
    from then on. Clients reconnect by themselves. `ready` gets the router as soon as clients can connect, also after a
    restart; the rest as of `serve`. Raises EndpointError if an endpoint is malformed, not on loopback without a lab, or
    taken, or if the lab cannot be used.
    """
    register = _register(endpoints)
    patience_s = 0.0
    read = _stamp(register)  # read before the register: a change in between is detected
    chosen = config(settings("router", listen=endpoints, connect=link, name="router", rights=rights))
    while True:
        with closing_cleanly(_routing(chosen, endpoints, patience_s, stop)) as (session, declared):
            guard = None
            if register is not None and rights is not None:
                guard = Guard(session, partial(lab.register, register.parent), rights)
                declared.append(guard)
            ready(session)
            patience_s = PORT_FREE_S
            while not stop.wait(LOOK_AGAIN_S):
                forbid_lingering()
                if guard is not None:
                    guard.report()
                if (now := _stamp(register)) == read:
                    continue
                read = now
                try:
                    chosen = config(settings("router", listen=endpoints, connect=link, name="router", rights=rights))
                except ExplainedError as error:  # the former rules still hold
                    print(f"router: {error}", file=sys.stderr, flush=True)
                    continue
                print("router: the lab has changed; its rules are enforced from now on", flush=True)
                break
            else:
                return


class Guard:
    """Disconnects sessions of a lab's router that pass for others, or that are more than the router can bear.

    Zenoh compares ids with no certificates: who connects first with the id of a robot (`lab.session_id`), as after a
    restart of the router, keeps that robot out. A member that does not read delays all others for a moment, and each of
    many does. Tokens cost the router more than in proportion to their number. Each is reported on standard error and as
    a hazard of the run.

    The guard follows events of links and of liveliness. It never asks for the tables of the router: questions to the
    admin space made it stand still for good.
    """

    def __init__(self, session: zenoh.Session, read: Callable[[], lab.Register], rights: Rights) -> None:
        """`read` returns the register of the lab as it is now; it raises LabError, here too."""
        self._session, self._read, self._rights = session, read, rights
        self._known = read()
        self._keys = Keys(rights.realm)
        self._reported: set[str] = set()
        self._clock = Clock()
        self._hazards: deque[str] = deque()  # not published yet
        self._links: dict[str, list[zenoh.Link]] = {}  # links of each certificate
        self._tokens = Counter[str]()  # tokens of each first chunk below the realm
        # in the receiving thread: each moment that a thief stays is one in which the robot is refused
        callback = Callback(self._check_link, indirect=False)
        self._listener = session.info.declare_link_events_listener(callback, history=True)
        self._watch = session.liveliness().declare_subscriber(
            self._keys.everything, Callback(self._check_token, indirect=False), history=True
        )

    def report(self) -> None:
        """Publish what was done since the last call."""
        while self._hazards:
            event = messages.Event(self._clock.utc(), "hazard", "router", self._hazards.popleft())
            self._session.put(self._keys.event, messages.encode(event), encoding=messages.JSON)

    def _check_link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        same = self._links.setdefault(link.auth_identifier or "", [])
        if event.kind == zenoh.SampleKind.DELETE:
            same[:] = [each for each in same if (each.zid, each.dst) != (link.zid, link.dst)]
            return
        same.append(link)
        if (victim := self._robbed(link)) is not None:
            self._disconnect(link, f"came with the id of {victim}")
        elif len(same) > MOST_SESSIONS and not self._trusted(link):
            self._disconnect(link, f"is one of more than {MOST_SESSIONS}")

    def _robbed(self, link: zenoh.Link) -> str | None:
        """Identity that lost its id to a session, by the current register: a certificate may come before its rules."""
        victim = lab.robbed(self._known, str(link.zid), link.auth_identifier)
        if victim is not None:
            with suppress(lab.LabError):
                return lab.robbed(self._read(), str(link.zid), link.auth_identifier)
        return victim

    def _check_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        owner = self._keys.robot_of(key) or ""
        if sample.kind == zenoh.SampleKind.DELETE:
            self._tokens[owner] -= 1
            return
        self._tokens[owner] += 1
        if self._tokens[owner] > MOST_TOKENS:  # a token does not tell its session
            for certificate in self._holders(zenoh.KeyExpr(key)):
                for link in self._links.pop(certificate, ()):
                    self._disconnect(link, f"may hold some of more than {MOST_TOKENS} liveliness tokens")

    def _holders(self, token: zenoh.KeyExpr) -> Iterator[str]:
        """Certificates with the right to hold a token."""
        for name, identity in self._known.identities.items():
            grants = self._rights.robots if identity.role == "robot" else self._rights.roles
            grant = grants.get(name if identity.role == "robot" else identity.role)
            if grant is not None and any(zenoh.KeyExpr(key).includes(token) for key in grant.tokens):
                yield identity.common_name

    def _disconnect(self, link: zenoh.Link, what: str) -> None:
        done = "is disconnected" if hang_up_on(link) else "cannot be disconnected, only TLS can: revoke the certificate"
        text = f"a session with the certificate of {link.auth_identifier} {what}; it {done}"
        if text not in self._reported:
            self._reported.add(text)
            self._hazards.append(text)
            print(f"router: {text}", file=sys.stderr, flush=True)

    def _trusted(self, link: zenoh.Link) -> bool:
        """Whether it is the link of a router, or of an operator, who may have to stop robots."""
        return any(
            each.role in ("router", "operator") and each.common_name == link.auth_identifier
            for each in self._known.identities.values()
        )


class StuckCheck:
    """Ends the process when its router answers no question: it would live on, and answer no client.

    Who started the router starts it again. A process that was suspended is not ended: `LOOK_AGAIN_S` counts at most
    once for each turn of the thread.
    """

    def __init__(self, ask: Callable[[], bool], end: Callable[[int], object] | None = None) -> None:
        """`ask` returns whether there was an answer; `end` ends the process with an exit code."""
        self._ask, self._end = ask, end or os._exit
        self._asked = self._answered = 0  # number of questions
        self._over = threading.Event()

    def start(self) -> None:
        for each in (self._ask_on, self._watch):
            threading.Thread(target=each, name="stuck", daemon=True).start()

    def end(self) -> None:
        self._over.set()

    def _ask_on(self) -> None:
        while not self._over.wait(LOOK_AGAIN_S):
            self._asked += 1
            if self._ask():
                self._answered = self._asked

    def _watch(self) -> None:
        turns = seen = 0
        while turns * LOOK_AGAIN_S < STUCK_S:
            if self._over.wait(LOOK_AGAIN_S):
                return
            turns = turns + 1 if self._answered == seen else 0
            seen = self._answered
        print(f"router: it has not answered itself for {STUCK_S:g} s, and ends", file=sys.stderr, flush=True)
        self._end(1)


def _answers(session: zenoh.Session) -> bool:
    """Whether a router answers itself; true of one that is closed, since its rules change or it ends."""
    try:
        return tokens_present(session, Keys().conductor) is not None
    except zenoh.ZError:
        return True


def _routing(chosen: zenoh.Config, endpoints: Sequence[str], wait_s: float, stop: threading.Event) -> zenoh.Session:
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return network.open_with(chosen)
        except zenoh.ZError as error:
            if time.monotonic() < deadline and not stop.wait(AGAIN_S):
                continue
            raise EndpointError(
                f"cannot listen on {', '.join(lab.bare(endpoints))}: {reason(error)}. If a router runs there already, "
                "use it; else choose another port with --listen"
            ) from None


def _register(endpoints: Sequence[str]) -> Path | None:
    folder = lab.lab_of(endpoints)
    return None if folder is None else folder / lab.REGISTER


def _stamp(file: Path | None) -> int:
    """Changes when a file does."""
    try:
        return 0 if file is None else file.stat().st_mtime_ns
    except OSError:
        return 0


class RouterLaunch(msgspec.Struct, frozen=True, kw_only=True):
    """A Zenoh router on this machine."""

    listen: Annotated[list[str], Meta(title="ENDPOINT", description=f"default: {DEFAULT_ENDPOINT}")] = []
    connect: Annotated[list[str], Meta(title="ENDPOINT", description="another router")] = []
    lifeline: Annotated[bool, Meta(description="end when standard input ends or is silent")] = False
    linger: Annotated[float, Meta(title="SECONDS", description="time to stay afterwards")] = 0.0
    rights: Annotated[str | None, Meta(title="FILE", description="rights of identities, in a lab")] = None


def _launched(launch: RouterLaunch) -> int:
    rights = None if launch.rights is None else msgspec.json.decode(Path(launch.rights).read_bytes(), type=Rights)
    listen = launch.listen or [DEFAULT_ENDPOINT]
    return serve(listen, link=launch.connect, lifeline=launch.lifeline, linger_s=launch.linger, rights=rights)


def main(arguments: Sequence[str] | None = None) -> int:
    return command_line.run("zenpark router", RouterLaunch, _launched, arguments, (OSError, msgspec.MsgspecError))


if __name__ == "__main__":
    end(main)
