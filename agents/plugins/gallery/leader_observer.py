"""Tracking of a leader by an observer of its velocity."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Annotated, ClassVar

from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, Positive, RobotFacts, Said, View


class LeaderObserver(Law, frozen=True):
    """v_i = v̂_i − k/n Σ_j (p_i − p̂_j − d_ij), v̂̇_i = −γ/n Σ_j (v̂_i − v̂_j), seen from above, with n neighbours j.

    The leader, which has no links of its own, transmits the velocity of its plan; all others estimate it from received
    values. If every robot receives the leader, directly or through others, the lag behind a leader of constant speed
    goes to zero. Without v̂ the lag is proportional to the speed (Y. Hong, J. Hu, L. Gao, "Tracking control for
    multi-agent consensus with an active leader and variable topology", Automatica 42(7), 2006; Y. Hong, G. Chen, L.
    Bushnell, "Distributed observers design for leader-following control of multi-agent networks", Automatica 44(3),
    2008; Y. Cao, W. Ren, "Distributed coordinated tracking with reduced interaction via a variable structure approach",
    IEEE Transactions on Automatic Control 57(1), 2012). No integral of an error: a robot that is held winds nothing up.
    All transmit their number of links from a leader: without a leader it grows to the number of robots, and v̂ is 0.
    """

    NEEDS = "relative"
    PREDICTION: ClassVar[str] = "constant-velocity"
    MEASURES: ClassVar[Mapping[str, Measure]] = {"lag": Measure("m")}
    SAYS: ClassVar[Mapping[str, Said]] = {
        "v": Said(unit="m/s", metre=0.1),  # 1 cm of threshold: 1 mm/s
        "links": Said(metre=1e-3),
    }

    gain: Annotated[Positive, Meta(description="k [1/s]")] = 0.5
    observer: Annotated[Positive, Meta(description="γ [1/s]; steps of 0.1 s bear up to 10")] = 2.0

    def begin(self, robot: RobotFacts) -> Memory:
        """v: velocity of the leader [m/s], 0 at first; links to it, as many as robots: none is known."""
        return {"v": (0.0, 0.0), "links": (float(robot.count),)}

    def step(self, view: View, memory: Memory) -> Control:
        """Step of Euler's method, on the shares of received values."""
        v_x, v_y = memory["v"]
        if view.leads:
            return Control(memory={"v": view.target_velocity[:2], "links": (0.0,)})
        heard, most = view.known(*self.SAYS), float(view.robot.count)
        share = 1.0 / max(len(heard), 1)
        x, y, apart_x, apart_y = 0.0, 0.0, 0.0, 0.0
        for each in heard:
            x += share * (view.position[0] - each.position[0] - each.link.relative[0])
            y += share * (view.position[1] - each.position[1] - each.link.relative[1])
            apart_x += share * (v_x - each.said["v"][0])
            apart_y += share * (v_y - each.said["v"][1])
        rate = min(self.observer * view.step_s, 1.0)
        links = min([most, *(each.said["links"][0] + 1.0 for each in heard)])
        v_x, v_y = (v_x - rate * apart_x, v_y - rate * apart_y) if links < most else (0.0, 0.0)
        return Control(
            memory={"v": (v_x, v_y), "links": (links,)},
            velocity=(v_x - self.gain * x, v_y - self.gain * y, nan),
            measures={"lag": (x * x + y * y) ** 0.5},
        )
