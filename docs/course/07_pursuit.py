"""Exercise 7: cyclic pursuit."""

from math import cos, nan, sin

from zenpark import Control, Law


class Pursue(Law, frozen=True):
    """v_i = k R(−α) (p̂_j − p_i), seen from above."""

    PREDICTION = "constant-velocity"

    gain: float = 0.3  # k [1/s]
    angle: float = 0.0  # α [rad]

    def step(self, view, memory):
        x = sum(each.position[0] - view.position[0] for each in view.neighbours)
        y = sum(each.position[1] - view.position[1] for each in view.neighbours)
        # blank: turned_x = turned_y = 0.0  # fill in: x, y turned to the right by the angle, times the gain
        turned_x = self.gain * (cos(self.angle) * x + sin(self.angle) * y)
        turned_y = self.gain * (cos(self.angle) * y - sin(self.angle) * x)
        # end of blank
        return Control(velocity=(turned_x, turned_y, nan))
