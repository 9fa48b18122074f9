"""A robot that was started by hand or at boot joins whatever is run next: the conductor tells everybody what that is.

It has no lifeline of standard input; the conductor's token on the network stands for it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import zenoh

from agents.network import lab, pubsub
from agents.network import session as network
from agents.network.endpoints import EndpointError
from agents.network.keys import Keys
from agents.runtime.lifeline import SILENCE_S
from experiments.file import document
from experiments.file.document import Document
from experiments.file.problems import DocumentError

LOOK_S: Final = 0.1


def offered(session: zenoh.Session, keys: Keys, names: Sequence[str]) -> Document:
    """Waits until an experiment is run that has robots of these names, and returns it as it is run.

    Args:
        session: To listen on.
        keys: Of the realm.
        names: Of the robots.
    """
    told = pubsub.pose_subscriber(session, keys.experiment, 1)
    pause = threading.Event()
    while True:
        for sample in network.received(told.handler):
            try:
                read = document.received(sample.payload.to_bytes().decode(errors="replace"), str(sample.key_expr))
            except DocumentError as error:
                print(f"not joined: {error}", flush=True)
                continue
            if set(names) <= set(read.experiment.robots):
                told.undeclare()  # type: ignore[no-untyped-call]
                return read
            print(f"not joined: {read.experiment.title} has no {', '.join(names)}", flush=True)
        pause.wait(LOOK_S)


class ConductorWatch:
    """Ends this process, as SIGTERM does, when the conductor is gone: its robots land first.

    Without a router every token is gone: then nobody knows, and the robots do what they do without a router.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, silence_s: float = SILENCE_S) -> None:
        """Watches from now on.

        Args:
            session: Of its own: open as long as this is to watch.
            keys: Of the realm.
            silence_s: A conductor that is gone for this long is gone [s].
        """
        self._session, self._silence_s = session, silence_s
        self._watch = pubsub.AliveWatch(session, keys.conductor)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="tether", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Watches no more."""
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        there, gone_s = True, 0.0
        while not self._over.wait(LOOK_S):
            for _, alive in self._watch.changes():
                there = alive
            gone_s = 0.0 if there or not network.connected(self._session) else gone_s + LOOK_S
            if gone_s > self._silence_s:
                print("the conductor is gone", flush=True)
                os.kill(os.getpid(), signal.SIGTERM)
                return


def reached(connect: Sequence[str], folder: str | None) -> list[str]:
    """The routers to ask, each with its lab if there is one.

    Raises:
        EndpointError: If a router of a lab asks for no certificates.
    """
    try:
        return lab.secured(connect, None if folder is None else Path(folder).absolute())
    except lab.LabError as error:
        raise EndpointError(str(error)) from None
