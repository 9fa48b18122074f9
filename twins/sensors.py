"""Range sensors of twins: where each looks, how far, how often and how well."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.body import BodyRequest, Rays
from twins.engine import Engine
from twins.world import World

SENSORS: Final[dict[str, object]] = {"infrared": None, "ultrasonic": None, "lds01": None, "multiranger": None}
OF_KIND: Final[dict[str, tuple[str, ...]]] = {
    "khepera4": ("infrared", "ultrasonic"),
    "turtlebot3": ("lds01",),
    "crazyflie": (),
    "tello": (),
}


class RangeSensors:
    """The range sensors of all rows of a world.

    Attributes:
        rays: What they saw last; None before the first sweep.
    """

    def __init__(self, request: BodyRequest, world: World) -> None:
        self.rays: Rays | None = None
        self._rows = np.arange(len(request.names))
        self._world = world

    def sweep(self, t: float, engine: Engine) -> None:
        """Measures what is due at `t` [s]."""
