"""The place that twins share: what stands in it, which engine moves them, what they see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from agents.rows import Index, Mask
from twins.scene import Scene


@dataclass(frozen=True)
class World:
    """The place that twins share.

    Attributes:
        copy: (n,) which copy of it a row is in: repetitions of an experiment are as many copies.
        scene: What stands there.
        engine: A registered engine: its name, or a table with its `kind` and parameters.
        sensors: The range sensors of each row, by name (`twins.sensors.SENSORS`).
        sensor_noise: Of the range sensors, as a multiple of the real ones'.
        mirrored: (n,) rows that are elsewhere in reality, and appear here where they are said to be.
    """

    copy: Index
    scene: Scene
    engine: str | Mapping[str, object]
    sensors: tuple[tuple[str, ...], ...]
    sensor_noise: float
    mirrored: Mask

    @classmethod
    def alone(cls, rows: int) -> World:
        """Every row by itself, in a room without end."""
        nobody = np.zeros(rows, dtype=bool)
        return cls(np.arange(rows), Scene.empty(), "point-mass", ((),) * rows, 1.0, nobody)
