"""Control updates: rows whose law is computed anew; the others keep their goal."""

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
    """View of a control trigger: ε is the change of the input of the law since its last computation.

    The input of a row are the relative positions p_i − p̂_j on its links, as it believes them, and p_i if it keeps a
    distance to a fixed object; ‖ε‖ is the largest change of one. Offset, error and energy are computed on first use.
    """

    def __init__(  # noqa: PLR0917 - one caller
        self,
        t: float,  # now [s]
        position: Array,  # (N, 3) own [m]
        velocity: Array,  # (N, 3) own [m/s]
        last_event: LastEvent,  # last computation of each row
        start: Array,  # (N,) start of each row [s]
        links: Links,
        last: tuple[Array, Array],  # relative positions [m] and their rates [m/s] (L, 3) at the last computation
        now: tuple[Array, Array],  # the same now
        anchored: Mask,  # (N,) rows whose law also depends on their own position in the room
        law: Callable[[], Array],  # computes the offset (N, 3) as it would be now [m]
        errors: Callable[[], tuple[Array, Array]],  # computes error (N,) [m] and energy (N,) [m²]
    ) -> None:
        self.t, self.position, self.velocity, self.last_event, self.start = t, position, velocity, last_event, start
        self.predictor, self._anchored = HOLD, anchored
        self.links, self._last, self.now, self._law, self._errors = links, last, now, law, errors

    def __getattr__(self, name: str) -> Array:
        """Offset, error and energy, on first use."""
        if name == "offset":
            self.offset = self._law()
        elif name in {"error", "energy"}:
            self.error, self.energy = self._errors()
        else:
            raise AttributeError(f"a view has no '{name}'")
        return np.asarray(getattr(self, name))

    @cached_property
    def deviation(self) -> Array:
        """(N,) ‖ε‖ [m]."""
        gap = self.links.max_by_receiver(norm(self.now[0] - self._last[0]), len(self.position))
        if some(self._anchored):
            gap = np.where(self._anchored, np.maximum(gap, norm(self.position - self.last_event.position)), gap)
        return gap

    @property
    def drift(self) -> Array:
        """(N,) rate at which ε began to grow after the last computation, as known then [m/s]."""
        drift = self.links.max_by_receiver(norm(self._last[1]), len(self.position))
        if some(self._anchored):
            drift = np.where(self._anchored, np.maximum(drift, norm(self.last_event.velocity)), drift)
        return drift


class ControlUpdates:
    """Choice of rows (N) whose law is computed anew, and the inputs of their last computation."""

    def __init__(self, trigger: Trigger, rows: int, links: Links) -> None:
        self.last_event = LastEvent(rows)  # last computation of each row
        self._trigger, self._state = trigger, trigger.state(rows)
        self._apart, self._rate = np.zeros((2, len(links), 3))
        self._active: Index = np.zeros(0, dtype=np.intp)

    def inputs(self, links: Index) -> tuple[Array, Array]:
        """Relative positions [m] and rates [m/s] (L, 3) of the last computation, for the active `links` (L,)."""
        self._active = links
        return self._apart[links], self._rate[links]

    def due(self, view: ControlView) -> Mask:
        """Rows (N,) that compute the law now; rows without a known position do not."""
        rows = due_rows(self._trigger, view, self._state)
        due = np.zeros(len(view.position), dtype=bool)
        due[rows] = np.isfinite(view.position[rows]).all(axis=1)
        if some(due):
            self.last_event.record(np.flatnonzero(due), view)
            anew = due[view.links.receiver]
            at = self._active[anew]
            self._apart[at], self._rate[at] = view.now[0][anew], view.now[1][anew]
        return due

    def require_update(self, rows: Index) -> None:
        """These rows compute the law at the next decision, whatever the trigger decides."""
        self.last_event.time[rows] = -np.inf
