"""Exercise 1: a law by which robots meet."""

from math import nan

from zenpark import Control, Law


class Meet(Law, frozen=True):
    """v_i = k Σ_j (x̂_j − x_i) along x; each robot keeps its lane."""

    gain: float = 0.3  # k [1/s]

    def step(self, view, memory):
        x = view.position[0]
        to_x = 0.0
        for each in view.neighbours:
            # blank: ...  # add the way from x to the x of `each.position`, which is x, y, z [m]
            to_x += each.position[0] - x
            # end of blank
        return Control(velocity=(self.gain * to_x, 0.0, nan))  # NaN: the height is held
