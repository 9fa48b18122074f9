"""What a robot process is told of its network, its clock and its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from agents.clock import Clock
from agents.network import messages
from agents.network.access_control import Rights
from agents.network.channel_model import Conditions
from agents.network.keys import Keys
from agents.runtime.watchdog import SILENCE_S

Ranging = Literal["body", "world", "far"]


@dataclass(frozen=True)
class Setup:
    """Where a robot process finds its network and how it talks.

    Attributes:
        keys: Key expressions of the realm.
        endpoints: Routers, or the members of a mesh.
        encoding: Of the payloads that it sends.
        state_hz: Rate of telemetry.
        lifeline: Whether standard input is a lifeline.
        located: Which rows get their position from outside.
        ranging: Where each row's range readings come from: its body; the world, which says them on the row's key
            `ranges` ("world"); or that key too, but the body hears them by itself ("far"). Left out: the bodies.
        conditions: What is done to poses that have come from neighbours, on each link; None: nothing.
        goal_conditions: The same for goals that have come from a centre, for each guided row.
        clock: Of the experiment.
        once: Whether the process ends when its robots are down after an experiment.
        rights: Who may do what, which robots enforce themselves in the mesh of a lab.
        loop_silence_s: A loop without a tick for so long hangs: its robots are landed from outside of it [s].
    """

    keys: Keys
    endpoints: Sequence[str]
    encoding: messages.Encoding
    state_hz: float
    lifeline: bool
    located: Sequence[bool]
    ranging: Sequence[Ranging] = ()
    conditions: Conditions | None = None
    goal_conditions: Conditions | None = None
    clock: Clock = field(default_factory=Clock)
    once: bool = False
    rights: Rights | None = None
    loop_silence_s: float = SILENCE_S
