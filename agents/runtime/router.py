"""The router process: `python -m agents.runtime.router`.

Light to start, since every run on one machine starts one.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final

import msgspec
import zenoh
from msgspec import Meta
from zenoh.handlers import Callback, FifoChannel

from agents.clock import Clock
from agents.errors import ExplainedError
from agents.network import lab, messages
from agents.network.access_control import Rights
from agents.network.endpoints import DEFAULT_ENDPOINT, EndpointError
from agents.network.keys import Keys
from agents.network.session import deserted, forbid_lingering, hang_up_on, prompt_threads
from agents.network.shutdown import closing_cleanly, end
from agents.network.zenoh_config import config, reason, settings
from agents.runtime import command_line
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import GONE, Lifeline

EMPTY_S: Final = 1.0  # no client for this long: a client that lost its connection would be back
LOOK_S: Final = 0.1
PORT_FREE_S: Final = 10.0  # limit for the port of a router that restarts to become free
AGAIN_S: Final = 0.1
MOST_TOKENS: Final = 1000  # of a session: they cost the router 40 ms, three times as many 0.3 s, ten times 4.6 s
MOST_REPLIES: Final = 1 << 16  # queued
# Period of the checks for new connections, tokens, revoked certificates and signals: a signal that the kernel delivers
# to another thread, as after a SIGCONT, does not wake the waiting one.
LOOK_AGAIN_S: Final = 0.5


def serve(
    endpoints: Sequence[str],  # to listen on: on loopback, or anywhere with a lab
    *,
    link: Sequence[str] = (),  # other routers, with which it shares all keys
    lifeline: bool = False,  # standard input is a lifeline
    linger_s: float = 0.0,  # time that it stays after its loss, for robots that land [s]; less without clients
    rights: Rights | None = None,  # of all identities, in a lab
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

    def ready(session: zenoh.Session) -> None:
        begun = bool(open_now)
        open_now[:] = [session]
        if begun:
            return
        print(f"router ready on {', '.join(endpoints)}", flush=True)
        if lifeline:
            rope.start()
            threading.Thread(target=leave, args=(open_now,), name="linger", daemon=True).start()

    with on_termination(stop.set):
        serve_router(endpoints, stop, link=link, ready=ready, rights=rights)
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
    read = _stamp(register)  # before reading: a change in between is detected
    chosen = config(settings("router", listen=endpoints, connect=link, name="router", rights=rights))
    while True:
        with closing_cleanly(_routing(chosen, endpoints, patience_s, stop)) as (session, declared):
            guard = None
            if register is not None and rights is not None:
                guard = Guard(session, lab.register(register.parent), rights.realm)
                declared.append(guard)
            ready(session)
            patience_s = PORT_FREE_S
            while not stop.wait(LOOK_AGAIN_S):
                forbid_lingering()
                if guard is not None:
                    guard.check_tokens()
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
    """Disconnects sessions of a lab's router that pass for others, or hold more tokens than the router can bear.

    Zenoh compares ids with no certificates: who connects first with the id of a robot (`lab.session_id`), as after a
    restart of the router, keeps that robot out. Samples of tokens do not tell their session, the tables of the router
    do. Each is reported on standard error and as a hazard of the run.
    """

    def __init__(self, session: zenoh.Session, known: lab.Register, realm: str) -> None:
        self._session, self._known, self._keys = session, known, Keys(realm)
        self._told: set[str] = set()
        self._clock = Clock()
        self._hazards: deque[str] = deque()  # not published yet
        self._banned: set[str] = set()  # ids of sessions, which a client keeps when it connects again
        # in the receiving thread: each moment that a thief stays is one in which the robot is refused
        callback = Callback(self._check, indirect=False)
        self._listener = session.info.declare_link_events_listener(callback, history=True)

    def check_tokens(self) -> None:
        """Compare the tokens in the tables of the router with the sessions that declared them; poll it."""
        # another router declares the tokens of its own clients, which it compares itself
        links = {str(link.zid): link for link in self._session.info.links() if not self._is_router(link)}
        connections = Counter[str]()
        for key, declarers in declared_tokens(self._session):
            named = Keys.session_of(key)
            for zid in declarers & links.keys():
                connections[zid] += 1
                if named not in (None, zid):
                    self._ban(links[zid], f"holds a token of {self._keys.whose(key)} in the name of another session")
        for zid, count in connections.items():
            if count > MOST_TOKENS:
                self._ban(links[zid], f"holds more than {MOST_TOKENS} liveliness tokens")
        while self._hazards:
            event = messages.Event(self._clock.utc(), "hazard", "router", self._hazards.popleft())
            self._session.put(self._keys.event, messages.encode(event), encoding=messages.JSON)

    def _check(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        if event.kind == zenoh.SampleKind.DELETE:
            return
        if (victim := lab.robbed(self._known, str(link.zid), link.auth_identifier)) is not None:
            self._disconnect(link, f"came with the id of {victim}")
        elif str(link.zid) in self._banned:
            hang_up_on(link)

    def _ban(self, link: zenoh.Link, what: str) -> None:
        if str(link.zid) not in self._banned:
            self._banned.add(str(link.zid))
            self._disconnect(link, what)

    def _disconnect(self, link: zenoh.Link, what: str) -> None:
        done = "is disconnected" if hang_up_on(link) else "cannot be disconnected, only TLS can: revoke the certificate"
        text = f"a session with the certificate of {link.auth_identifier} {what}; it {done}"
        if text not in self._told:
            self._told.add(text)
            self._hazards.append(text)
            print(f"router: {text}", file=sys.stderr, flush=True)

    def _is_router(self, link: zenoh.Link) -> bool:
        return any(
            each.role == "router" and each.common_name == link.auth_identifier
            for each in self._known.identities.values()
        )


def declared_tokens(session: zenoh.Session) -> Iterator[tuple[str, set[str]]]:
    """Keys of the liveliness tokens in the tables of a router, each with the ids of the sessions that declared it.

    The tables show neither denied tokens nor keys with a chunk that begins with @, such as those of caches.
    """
    tables = f"@/{session.zid()}/router/token/"
    for reply in session.get(f"{tables}**", FifoChannel(MOST_REPLIES)):
        if reply.ok is not None:
            sources = msgspec.json.decode(reply.ok.payload.to_bytes(), type=dict[str, set[str]])
            yield str(reply.ok.key_expr).removeprefix(tables), set().union(*sources.values())


def _routing(chosen: zenoh.Config, endpoints: Sequence[str], wait_s: float, stop: threading.Event) -> zenoh.Session:
    deadline = time.monotonic() + wait_s
    while True:
        try:
            with prompt_threads():
                return zenoh.open(chosen)
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
    end(main())
