"""Exercise 1: a law by which robots meet."""

from math import nan

from zenpark import Control, Law


class Meet(Law, frozen=True):
    """v_i = k Σ_j (p̂_j − p_i), seen from above."""

    gain: float = 0.3  # k [1/s]

    def step(self, view, memory):
        x, y, _ = view.position
        to_x = to_y = 0.0
        for each in view.neighbours:
            to_x += each.position[0] - x
            to_y += each.position[1] - y
        return Control(velocity=(self.gain * to_x, self.gain * to_y, nan))  # NaN: the height is held
