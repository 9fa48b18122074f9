"""What rows know of the things around them: from their own range readings, and from whom they hear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agents.avoidance import Nearby, Self
from agents.body import BodyState
from agents.graph import Links
from agents.kinds import Kind

if TYPE_CHECKING:
    from agents.agent import Heard


class Sight:
    """Puts together what `Avoidance` decides on."""

    def __init__(self, kinds: Sequence[Kind], speaker_kinds: Sequence[Kind], links: Links) -> None:
        self._kinds, self._links = kinds, links
        self._speaker_kinds = speaker_kinds

    def see(self, t: float, state: BodyState, heard: Heard) -> tuple[Self, Nearby]:
        """What rows know of themselves and of what is near at `t` [s]."""
        raise NotImplementedError
