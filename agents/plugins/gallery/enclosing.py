"""Enclosing of a target."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, cos, hypot, nan, pi, sin
from typing import Annotated, ClassVar

from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, Positive, RobotFacts, Said, View, is_known


class Enclosing(Law, frozen=True):
    """v_i = v̂_i + λ (R − r_i) e_r + k (φ_j − φ_i) r_i e_φ about x̂_i, the estimate of a target; j is next on the left.

    The robots end on a circle of radius R, 2π/n apart, and go round it at 2πk/n: cyclic pursuit of the angles
    (T.-H. Kim, T. Sugie, "Cooperative control for target-enclosing based on a cyclic pursuit strategy", Automatica
    43(8), 2007). The target is the robot without links of its own, and those with a link from it see it. The others
    estimate place and velocity from what m neighbours say: x̂̇_i = v̂_i − γ/m Σ_j (x̂_i − x̂_j), v̂̇_i = −γ/m Σ_j (v̂_i − v̂_j).
    Links join neighbours on the circle. All say how many links they are from the target: where it is lost, the count
    grows to that of robots, and they stay where they are.
    """

    PREDICTION: ClassVar[str] = "constant-velocity"
    MEASURES: ClassVar[Mapping[str, Measure]] = {"radius": Measure("m", better=""), "gap": Measure("rad", better="")}
    SAYS: ClassVar[Mapping[str, Said]] = {
        "target": Said(unit="m", place=0),
        "speed": Said(unit="m/s", metre=0.5),  # 1 cm of threshold: 5 mm/s
        "links": Said(metre=1e-3),
    }

    radius: Annotated[Positive, Meta(description="R [m]")] = 0.6
    pursuit: Annotated[Positive, Meta(description="k [1/s]")] = 0.3
    closing: Annotated[Positive, Meta(description="λ [1/s]")] = 0.8
    observer: Annotated[Positive, Meta(description="γ [1/s]; steps of 0.1 s bear up to 10")] = 3.0

    def begin(self, robot: RobotFacts) -> Memory:
        """Place [m] and velocity [m/s] of the target, not known, and links to it, as many as robots."""
        return {"target": (nan, nan), "speed": (0.0, 0.0), "links": (float(robot.count),)}

    def step(self, view: View, memory: Memory) -> Control:
        """Velocity about the estimate; the target says what it is."""
        x, y, _ = view.position
        if view.leads:
            return Control(memory={"target": (x, y), "speed": view.target_velocity[:2], "links": (0.0,)})
        memory = self.estimate(view, memory)
        (a, b), (speed_x, speed_y) = memory["target"], memory["speed"]
        if memory["links"][0] >= view.robot.count:
            return Control(memory=memory, measures={"radius": nan, "gap": nan})
        radius, angle = hypot(x - a, y - b), atan2(y - b, x - a)
        others = [each.position for each in view.neighbours if each.said["links"][0] != 0.0]
        gap = min(((atan2(j_y - b, j_x - a) - angle) % (2.0 * pi) for j_x, j_y, _ in others), default=2.0 * pi)
        out, around = self.closing * (self.radius - radius), self.pursuit * gap * radius
        velocity = (
            speed_x + out * cos(angle) - around * sin(angle), speed_y + out * sin(angle) + around * cos(angle), nan
        )  # fmt: skip
        return Control(memory=memory, velocity=velocity, measures={"radius": radius, "gap": gap})

    def estimate(self, view: View, memory: Memory) -> Memory:
        """Place and velocity of the target, and links to it, after a step of Euler's method."""
        (a, b), (speed_x, speed_y) = memory["target"], memory["speed"]
        most = float(view.robot.count)
        heard = [each for each in view.known(*self.SAYS) if each.said["links"][0] + 1.0 < most]
        if not heard:
            return {"target": (a, b), "speed": (0.0, 0.0), "links": (most,)}
        links = 1.0 + min(each.said["links"][0] for each in heard)
        if links == 1.0:
            heard = [each for each in heard if each.said["links"][0] == 0.0]
        place_x = place_y = mean_x = mean_y = 0.0
        share = 1.0 / len(heard)
        for each in heard:
            (j_x, j_y), (v_x, v_y) = each.said["target"], each.said["speed"]
            mean_x, mean_y = mean_x + share * v_x, mean_y + share * v_y
            place_x, place_y = place_x + share * (j_x + each.age * v_x), place_y + share * (j_y + each.age * v_y)
        if links > 1.0 and is_known((a, b)):  # it does not see the target, and this is not the first received estimate
            rate = min(self.observer * view.step_s, 1.0)
            a, b = a + view.step_s * speed_x, b + view.step_s * speed_y
            place_x, place_y = a + rate * (place_x - a), b + rate * (place_y - b)
            mean_x, mean_y = speed_x + rate * (mean_x - speed_x), speed_y + rate * (mean_y - speed_y)
        return {"target": (place_x, place_y), "speed": (mean_x, mean_y), "links": (links,)}
