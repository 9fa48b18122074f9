"""Consensus on a meeting point."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Annotated

import msgspec
from msgspec import Meta

from zenpark import Control, Law, Positive, View


class Consensus(Law, frozen=True):
    """v_i = −k Σ_j (p_i − p̂_j): rendezvous, seen from above.

    On a connected undirected graph the mean of the places stays, and the robots approach it at the rate k λ₂, with λ₂
    the second smallest eigenvalue of the Laplacian (R. Olfati-Saber, J. A. Fax, R. M. Murray, "Consensus and
    cooperation in networked multi-agent systems", Proceedings of the IEEE 95(1), 2007). Robots that stand or follow
    plans lead: the others go into their hull (M. Ji, G. Ferrari-Trecate, M. Egerstedt, A. Buffa, "Containment control
    in mobile networks", IEEE Transactions on Automatic Control 53(8), 2008). With `offset` they keep places around the
    meeting point.
    """

    gain: Annotated[Positive, Meta(description="k [1/s]")] = 0.3
    offset: Annotated[
        dict[str, tuple[float, float]], Meta(description="by robot: place x, y [m] around the meeting point")
    ] = msgspec.field(default_factory=dict)

    def step(self, view: View, memory: Mapping[str, tuple[float, ...]]) -> Control:
        """−k Σ_j ((p_i − o_i) − (p̂_j − o_j))."""
        here_x, here_y, _ = view.position
        own_x, own_y = self.offset.get(view.robot.name, (0.0, 0.0))
        x = y = 0.0
        for each in view.neighbours:
            there_x, there_y = self.offset.get(each.name, (0.0, 0.0))
            x += here_x - own_x - each.position[0] + there_x
            y += here_y - own_y - each.position[1] + there_y
        return Control(velocity=(-self.gain * x, -self.gain * y, nan))
