"""An emergency stop ends the whole run: what stopped robots must not start again by itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zenoh

from agents import session as network
from agents import wire
from agents.keys import Keys
from agents.leaving import held
from agents.settings import ASK_S
from experiments.overview import ROUTER_S


class Emergency:
    """Listens for emergency stops as long as a run goes on, between its cases too.

    Attributes:
        said: The first one that was heard; None: there was none.
    """

    def __init__(self) -> None:
        self.said: wire.Stop | None = None

    def __bool__(self) -> bool:
        return self.said is not None

    @property
    def words(self) -> str:
        """Who stopped the run, and why; empty if nobody has."""
        return "" if self.said is None else self.said.words

    def listen(self, session: zenoh.Session, keys: Keys) -> network.Alarm:
        """Hears stops in a realm, for as long as what is returned is kept."""
        return network.Alarm(session, keys.estop, self._heed)

    @contextmanager
    def throughout(
        self, endpoints: Sequence[str], keys: Keys, identity: str, *, starting: bool = False
    ) -> Iterator[None]:
        """Hears stops by a session of its own: those of the cases are closed between them.

        Args:
            endpoints: Routers.
            keys: Of the realm.
            identity: Whose certificate is shown, in a lab.
            starting: The routers were started just now, which takes seconds on a busy machine.

        Raises:
            Unreachable: If no router answers.
        """
        wait_s = ROUTER_S if starting else ASK_S
        opened = network.open_session(endpoints, name="emergency stops", identity=identity, wait_s=wait_s)
        with held(opened) as (session, declared):
            declared.append(self.listen(session, keys))
            yield

    def _heed(self, stop: wire.Stop) -> None:
        self.said = self.said or stop
