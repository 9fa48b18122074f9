"""Safety rules: sentences of `docs/safety.md` that a laboratory is asked about while it runs, and afterwards."""

from __future__ import annotations

from pathlib import Path

from tests.simulated.world import LOOK_S, World


class Rules:
    def __init__(self, world: World) -> None:
        self.violations: list[tuple[str, float, str]] = []
        self.robot_s = 0.0
        self._world = world
        world.watchers.append(self._look)

    def _look(self) -> None:
        self.robot_s += LOOK_S * sum(1 for _ in self._world.motions())

    def judge(self, folder: Path) -> None:
        pass
