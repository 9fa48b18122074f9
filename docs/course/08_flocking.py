"""Exercise 8: alignment and separation."""

from math import cos, hypot, nan, sin

from zenpark import Control, Law, Said


class Flock(Law, frozen=True):
    """v̇_i = Σ_j a (v_j − v_i) + Σ_j b (d − ‖p_i − p_j‖)₊ (p_i − p_j)/‖p_i − p_j‖, seen from above."""

    PREDICTION = "constant-velocity"
    SAYS = {"v": Said(unit="m/s", metre=0.1)}

    align: float = 0.5  # a [1/s]
    push: float = 0.5  # b [1/s²]
    spacing: float = 0.5  # d [m]

    def begin(self, robot):
        """v: own velocity, another one for each robot at first."""
        turn = 2.0 * robot.number
        return {"v": (0.12 + 0.08 * cos(turn), 0.08 * sin(turn))}

    def step(self, view, memory):
        (vx, vy), (x, y, _) = memory["v"], view.position
        if not view.moves:  # held until the common start, or by safety
            return Control(memory=memory)
        ax = ay = 0.0
        for each in view.known("v"):
            away_x, away_y = x - each.position[0], y - each.position[1]
            apart = max(hypot(away_x, away_y), 1e-6)
            near = max(self.spacing - apart, 0.0)
            ax += self.push * near * away_x / apart
            ay += self.push * near * away_y / apart
            # blank: ...  # alignment: the velocity of the neighbour is each.said["v"]
            ax += self.align * (each.said["v"][0] - vx)
            ay += self.align * (each.said["v"][1] - vy)
            # end of blank
        vx, vy = vx + view.step_s * ax, vy + view.step_s * ay
        return Control(memory={"v": (vx, vy)}, velocity=(vx, vy, nan))
