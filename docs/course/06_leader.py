"""Exercise 6: a law that remembers and talks: an observer of the leader's velocity."""

from math import hypot, nan

from zenpark import Control, Law, Said


class Follow(Law, frozen=True):
    """v_i = v̂_i − k (p_i − p̂_j − d_ij) with v̂̇_i = −γ (v̂_i − v̂_j), for one neighbour j."""

    NEEDS = "relative"  # every link has a wanted place: `each.link.relative`
    PREDICTION = "constant-velocity"
    SAYS = {"v": Said(unit="m/s", metre=0.1)}  # goes out with each pose

    gain: float = 0.5  # k [1/s]
    observer: float = 2.0  # γ [1/s]

    def begin(self, robot):
        """v̂: 0 at first."""
        return {"v": (0.0, 0.0)}

    def step(self, view, memory):
        if view.leads:
            return Control(memory={"v": view.target_velocity[:2]})
        vx, vy = memory["v"]
        x = y = 0.0
        for each in view.known("v"):
            x = view.position[0] - each.position[0] - each.link.relative[0]
            y = view.position[1] - each.position[1] - each.link.relative[1]
            said_x, said_y = each.said["v"]
            # blank: ...  # a step of `view.step_s` [s] of Euler's method: vx and vy go towards said_x, said_y
            vx += view.step_s * self.observer * (said_x - vx)
            vy += view.step_s * self.observer * (said_y - vy)
            # end of blank
        velocity = (vx - self.gain * x, vy - self.gain * y, nan)
        return Control(memory={"v": (vx, vy)}, velocity=velocity, measures={"lag": hypot(x, y)})
