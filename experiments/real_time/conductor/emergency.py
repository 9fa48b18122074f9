"""Emergency stops during a run, between its cases too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import zenoh

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import closing_cleanly
from agents.network.zenoh_config import ASK_S

STARTING_S: Final = 10.0  # limit for routers that were just started: on a busy machine that takes seconds


class Emergency:
    """Reception of emergency stops."""

    def __init__(self) -> None:
        self.stop: messages.Stop | None = None  # the first one received

    def __bool__(self) -> bool:
        return self.stop is not None

    @property
    def words(self) -> str:
        """Sender and reason of the stop; empty without one."""
        return "" if self.stop is None else self.stop.words

    def listen(self, session: zenoh.Session, keys: Keys) -> pubsub.ImmediateSubscriber:
        """Receive stops in a realm until the subscriber is closed."""
        return pubsub.ImmediateSubscriber(session, keys.estop, self._receive_stop)

    @contextmanager
    def throughout(self, endpoints: Sequence[str], keys: Keys, identity: str, wait_s: float = ASK_S) -> Iterator[None]:
        """Receive stops by a session of its own: those of the cases are closed between them.

        `identity` is the name in the certificate, in a lab. Raises Unreachable if no router answers in `wait_s`.
        """
        opened = network.open_session(endpoints, name="emergency stops", identity=identity, wait_s=wait_s)
        with closing_cleanly(opened) as (session, declared):
            declared.append(self.listen(session, keys))
            yield

    def _receive_stop(self, stop: messages.Stop) -> None:
        self.stop = self.stop or stop
