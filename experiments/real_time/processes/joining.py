"""Start of a process of an experiment: it reads its case and joins the network; robots may join the next run.

A robot that was started by hand or at boot has no lifeline on standard input; the token of the conductor, which
publishes the experiment that is run, stands for it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Final, NamedTuple

import msgspec
import zenoh

from agents.clock import Clock
from agents.network import pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.name_ownership import NameTaken, OwnershipCheck, claim
from agents.network.shutdown import closing_cleanly
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import SILENCE_S, Lifeline
from experiments.definition import mesh
from experiments.definition.endpoints import router_endpoints
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import Document, chosen_case
from experiments.file.problems import DocumentError

LOOK_S: Final = 0.1


class Launch(msgspec.Struct, frozen=True, kw_only=True, rename="kebab"):
    """Command line of a process of an experiment."""

    file: Annotated[str, msgspec.Meta(description="experiment file, or name in the catalogue")]
    case: Annotated[str | None, msgspec.Meta(description="which case of the file; the first if left out")] = None
    connect: Annotated[list[str], msgspec.Meta(title="ENDPOINT", description="router")] = []
    lab: Annotated[str | None, msgspec.Meta(title="FOLDER", description="certificates; the file's if left out")] = None
    lifeline: Annotated[bool, msgspec.Meta(description="end when standard input ends or is silent")] = False

    def read(self) -> tuple[Plan, list[str]]:
        """The chosen case of the file, and the routers to use."""
        read = document.read(self.file)
        plan = chosen_case(read, self.case)
        return plan, router_endpoints(plan, read.path, self.connect, self.lab) or [DEFAULT_ENDPOINT]


class Network(NamedTuple):
    """The network of an experiment, as one of its processes has joined it."""

    session: zenoh.Session
    keys: Keys
    endpoints: list[str]
    declared: list[object]  # kept until the session is closed, see `agents.network.shutdown.leave`
    ownership: OwnershipCheck  # owner of the `token`


@contextmanager
def joined(
    plan: Plan,
    endpoints: list[str],
    *,
    name: str,  # name of the session, and of its certificate in a lab
    stop: threading.Event,  # ends the wait for a router when it is set
    on_signal: Callable[[], object],  # called by SIGINT and SIGTERM
    lost: threading.Event | None = None,  # set when the lifeline is lost; None: standard input is no lifeline
    on_line: Callable[[bytes], None] | None = None,  # called with each line of the lifeline that is no heartbeat
    token: str = "",  # liveliness key that only one process may own; empty: none
    taken: str = "",  # text of the error if another process owns it
) -> Iterator[Network]:
    """Inside, the network of an experiment is joined; at the end it is left.

    Raises:
        NameTaken: If another process owns `token`, or took it while this one stood still or was cut off.
        Unreachable: If no router answers.
    """
    began, realm = Clock().utc(), plan.experiment.network.realm
    if lost is not None:
        Lifeline(lost, on_line=on_line).start()
    with on_termination(on_signal):
        session = network.open_session(endpoints, name=name, stop=stop, rights=mesh.member_rights(plan, endpoints))
        with closing_cleanly(session) as (session, declared):
            if token:
                try:
                    declared.append(claim(session, [token], began=began, endpoints=endpoints, stop=stop))
                except NameTaken:
                    raise NameTaken(
                        f"{taken} in the realm '{realm}' already: end it first, choose another "
                        "router with --connect, or another network.realm in the experiment file"
                    ) from None
            ownership = OwnershipCheck([token] if token else [])
            try:
                yield Network(session, Keys(realm), endpoints, declared, ownership)
            except NameTaken:
                raise NameTaken(
                    f"another process has taken the name '{name}' in the realm '{realm}' while this "
                    "one stood still or was cut off; it leaves"
                ) from None
            finally:
                ownership.end()


def wait_for_experiment(session: zenoh.Session, keys: Keys, names: Sequence[str]) -> Document:
    """Waits for a run that has robots of these names, and returns its experiment."""
    subscriber = pubsub.pose_subscriber(session, keys.experiment, 1)
    pause = threading.Event()
    while True:
        for sample in network.received(subscriber.handler):
            try:
                read = document.received(sample.payload.to_bytes().decode(errors="replace"), str(sample.key_expr))
            except DocumentError as error:
                print(f"not joined: {error}", flush=True)
                continue
            if set(names) <= set(read.experiment.robots):
                subscriber.undeclare()
                return read
            print(f"not joined: {read.experiment.title} has no {', '.join(names)}", flush=True)
        pause.wait(LOOK_S)


class ConductorWatch:
    """Ends this process, as SIGTERM does, when the conductor's token is gone for `silence_s`: its robots land first.

    Without a router every token is gone, which proves nothing; the robots do what they do without a router.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, silence_s: float = SILENCE_S) -> None:
        self._session, self._silence_s = session, silence_s
        self._watch = pubsub.AliveWatch(session, keys.conductor)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch_token, name="conductor watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def _watch_token(self) -> None:
        stands, missing_s = True, 0.0
        try:
            while missing_s <= self._silence_s:
                if self._over.wait(LOOK_S):
                    return
                for _, alive in self._watch.changes():
                    stands = alive
                missing_s = 0.0 if stands or not network.connected(self._session) else missing_s + LOOK_S
            print("the conductor is gone", flush=True)
        finally:  # robots land whatever ends this watch, such as a terminal that is closed
            if not self._over.is_set():
                os.kill(os.getpid(), signal.SIGTERM)
