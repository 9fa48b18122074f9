"""The router process: `python -m agents.runtime.router`.

Light to start, since every run on one machine starts one.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import msgspec
import zenoh
from msgspec import Meta
from zenoh.handlers import Callback

from agents.errors import ExplainedError
from agents.network import lab
from agents.network.access_control import Rights
from agents.network.endpoints import DEFAULT_ENDPOINT, EndpointError
from agents.network.session import deserted, forbid_lingering, hang_up_on, prompt_threads
from agents.network.shutdown import end, held
from agents.network.zenoh_config import config, reason, settings
from agents.runtime import command_line
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import GONE, Lifeline

EMPTY_S: Final = 1.0  # no client for this long: a client that lost its connection would be back
LOOK_S: Final = 0.1
PORT_FREE_S: Final = 10.0  # limit for the port of a router that restarts to become free
AGAIN_S: Final = 0.1
# Period of the checks for new connections, for revoked certificates and for signals: a signal that the kernel delivers
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
        with held(_routing(chosen, endpoints, patience_s, stop)) as (session, declared):
            if register is not None:
                declared.append(Guard(session, lab.register(register.parent)))
            ready(session)
            patience_s = PORT_FREE_S
            while not stop.wait(LOOK_AGAIN_S):
                forbid_lingering()
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
    """Disconnects sessions of a lab's router whose ids were taken from others (`lab.session_id`).

    Zenoh compares ids with no certificates: who connects first with the id of a robot, as after a restart of the
    router, keeps that robot out.
    """

    def __init__(self, session: zenoh.Session, known: lab.Register) -> None:
        self._known = known
        self._told: set[tuple[str, str | None, bool]] = set()
        # in the receiving thread: each moment that a thief stays is one in which the robot is refused
        callback = Callback(self._check, indirect=False)
        self._listener = session.info.declare_link_events_listener(callback, history=True)

    def _check(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        if event.kind == zenoh.SampleKind.DELETE:
            return
        victim = lab.robbed(self._known, str(link.zid), link.auth_identifier)
        if victim is None:
            return
        told = (victim, link.auth_identifier, hang_up_on(link))
        if told not in self._told:
            self._told.add(told)
            done = "is disconnected" if told[-1] else f"cannot be disconnected: only TLS can; {victim} is kept out"
            who = f"with the certificate of {link.auth_identifier}"
            print(f"router: a session {who} came with the id of {victim}; it {done}", file=sys.stderr, flush=True)


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
    linger: Annotated[float, Meta(title="SECONDS", description="and then stay for so long")] = 0.0
    rights: Annotated[str | None, Meta(title="FILE", description="who may do what, in a lab")] = None


def _launched(launch: RouterLaunch) -> int:
    rights = None if launch.rights is None else msgspec.json.decode(Path(launch.rights).read_bytes(), type=Rights)
    listen = launch.listen or [DEFAULT_ENDPOINT]
    return serve(listen, link=launch.connect, lifeline=launch.lifeline, linger_s=launch.linger, rights=rights)


def main(arguments: Sequence[str] | None = None) -> int:
    return command_line.run("zenpark router", RouterLaunch, _launched, arguments, (OSError, msgspec.MsgspecError))


if __name__ == "__main__":
    end(main())
