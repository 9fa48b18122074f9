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
    """Where a robot process finds its network and how it talks."""

    keys: Keys  # key expressions of the realm
    endpoints: Sequence[str]  # routers, or the members of a mesh
    encoding: messages.Encoding  # of the payloads that it sends
    state_hz: float  # rate of telemetry
    lifeline: bool  # whether standard input is a lifeline
    located: Sequence[bool]  # which rows get their position from outside
    # where each row's range readings come from: its body; the world, which says them on the row's key `ranges`
    # ("world"); or that key too, but the body hears them by itself ("far"). Left out: the bodies.
    ranging: Sequence[Ranging] = ()
    # what is done to poses that have come from neighbours, on each link; None: nothing
    conditions: Conditions | None = None
    goal_conditions: Conditions | None = None  # the same for goals that have come from a centre, for each guided row
    clock: Clock = field(default_factory=Clock)  # of the experiment
    once: bool = False  # whether the process ends when its robots are down after an experiment
    rights: Rights | None = None  # who may do what, which robots enforce themselves in the mesh of a lab
    # a loop without a tick for so long hangs: its robots are landed from outside of it [s]
    loop_silence_s: float = SILENCE_S
