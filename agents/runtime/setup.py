"""Settings of a robot process: network, clock and sensors."""

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
    """Settings of a robot process."""

    keys: Keys  # key expressions of the realm
    endpoints: Sequence[str]  # routers, or the members of a mesh
    encoding: messages.Encoding  # of sent payloads
    state_hz: float  # [1/s] rate of telemetry
    lifeline: bool  # whether standard input is a lifeline
    located: Sequence[bool]  # rows with a position measured from outside
    # source of the range readings of each row: its body; the world, by the key `ranges` of the row ("world"); or that
    # key, received by the body itself ("far"). Left out: the bodies.
    ranging: Sequence[Ranging] = ()
    # effects of the modelled channel on received poses, by link; None: none
    conditions: Conditions | None = None
    goal_conditions: Conditions | None = None  # on received goals, by guided row
    clock: Clock = field(default_factory=Clock)  # of the experiment
    once: bool = False  # the process ends when its robots are down after an experiment
    rights: Rights | None = None  # enforced by the robots themselves in the mesh of a lab
    # [s] without a tick after which the watchdog lands the robots
    loop_silence_s: float = SILENCE_S
