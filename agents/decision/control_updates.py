"""When the law is computed anew, row by row; in between each row keeps the goal that it has."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from agents.arrays import Array, Index, Mask, norm, some
from agents.decision.transmission import due_rows
from agents.formation.graph import Links
from agents.plugins.predictors import HOLD
from agents.plugins.triggers import LastEvent, Trigger, View


class ControlView(View):
    """What a trigger sees in the place of control: ε is how far the input of the law has moved since it was computed.

    The input of a row are the relative positions p_i − p̂_j on its links, as it believes them, and p_i if it keeps a
    distance to what stands still; ‖ε‖ is the largest change of one. Offset, error and energy are computed when they
    are looked at.
    """

    def __init__(  # noqa: PLR0917 - one caller
        self,
        t: float,
        position: Array,
        velocity: Array,
        last_event: LastEvent,
        start: Array,
        links: Links,
        kept: tuple[Array, Array],
        now: tuple[Array, Array],
        anchored: Mask,
        law: Callable[[], Array],
        errors: Callable[[], tuple[Array, Array]],
    ) -> None:
        """Of rows that listen on `links` (E).

        Args:
            t: Now [s].
            position: (N, 3) own [m].
            velocity: (N, 3) own [m/s].
            last_event: The last computation of each row.
            start: (N,) when each row began [s].
            links: That are live.
            kept: Relative positions (E, 3) [m] from which the law was last computed, and their rates (E, 3) [m/s] then.
            now: The same now.
            anchored: (N,) rows whose law also depends on where they are in the room.
            law: Gives the offset (N, 3) as it would be now [m].
            errors: Gives error (N,) [m] and energy (N,) [m²].
        """
        self.t, self.position, self.velocity, self.last_event, self.start = t, position, velocity, last_event, start
        self.predictor, self._anchored = HOLD, anchored
        self.links, self._kept, self.now, self._law, self._errors = links, kept, now, law, errors

    @cached_property
    def offset(self) -> Array:
        """See `View.offset`."""
        return self._law()

    @cached_property
    def _both(self) -> tuple[Array, Array]:
        return self._errors()

    @property
    def error(self) -> Array:  # type: ignore[override]
        """See `View`."""
        return self._both[0]

    @property
    def energy(self) -> Array:  # type: ignore[override]
        """See `View`."""
        return self._both[1]

    @cached_property
    def deviation(self) -> Array:
        """(N,) ‖ε‖ [m]."""
        gap = self.links.max_by_receiver(norm(self.now[0] - self._kept[0]), len(self.position))
        if some(self._anchored):
            gap = np.where(self._anchored, np.maximum(gap, norm(self.position - self.last_event.position)), gap)
        return gap

    @property
    def drift(self) -> Array:
        """(N,) how fast ε began to grow after the law was computed, as was known then [m/s]."""
        drift = self.links.max_by_receiver(norm(self._kept[1]), len(self.position))
        if some(self._anchored):
            drift = np.where(self._anchored, np.maximum(drift, norm(self.last_event.velocity)), drift)
        return drift


class ControlUpdates:
    """Of N rows: decides whose law is computed anew, and remembers from what.

    Attributes:
        last_event: The last computation of each row.
    """

    def __init__(self, trigger: Trigger, rows: int, links: Links) -> None:
        """With all `links` (E) on which the rows listen."""
        self.last_event = LastEvent.none(rows)
        self._trigger, self._state = trigger, trigger.state(rows)
        self._apart, self._rate = np.zeros((2, len(links), 3))
        self._live: Index = np.zeros(0, dtype=np.intp)

    def view(
        self,
        t: float,
        position: Array,
        velocity: Array,
        *,
        start: Array,
        live: Index,
        links: Links,
        anchored: Mask,
        apart: Array,
        rate: Array,
        law: Callable[[], Array],
        errors: Callable[[], tuple[Array, Array]],
    ) -> ControlView:
        """View of the trigger; `live` (L,): indices of `links` among all links. For the rest see `ControlView`."""
        self._live = live
        kept = (self._apart[live], self._rate[live])
        return ControlView(
            t, position, velocity, self.last_event, start, links, kept, (apart, rate), anchored, law, errors
        )

    def due(self, view: ControlView) -> Mask:
        """Which rows (N,) compute the law now; those that do not know where they are do not."""
        rows = due_rows(self._trigger, view, self._state)
        due = np.zeros(len(view.position), dtype=bool)
        due[rows] = np.isfinite(view.position[rows]).all(axis=1)
        if some(due):
            self.last_event.record(np.flatnonzero(due), view)
            anew = due[view.links.receiver]
            at = self._live[anew]
            self._apart[at], self._rate[at] = view.now[0][anew], view.now[1][anew]
        return due

    def require_update(self, rows: Index) -> None:
        """These rows compute the law at the next decision, whatever the trigger says."""
        self.last_event.time[rows] = -np.inf
