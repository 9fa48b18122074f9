"""Exercise 9: Lloyd's descent on a grid of places."""

from math import dist, nan

from zenpark import Control, Law

GRID = [(0.3 * column - 1.8, 0.3 * row - 1.8) for column in range(13) for row in range(13)]  # x, y [m]


class Cover(Law, frozen=True):
    """v_i = k (c_i − p_i), with c_i the mean of the places that are nearest to robot i."""

    ALONE = True  # moves without neighbours, too
    gain: float = 1.0  # k [1/s]

    def step(self, view, memory):
        own, others = view.position[:2], [each.position[:2] for each in view.neighbours]
        cell = []
        for place in GRID:
            # blank: ...  # append the place to the cell if no other is nearer to it than `own`: dist(place, own)
            if all(dist(place, own) <= dist(place, other) for other in others):
                cell.append(place)
            # end of blank
        if not cell:
            return Control()
        x, y = (sum(place[axis] for place in cell) / len(cell) for axis in (0, 1))
        return Control(velocity=(self.gain * (x - own[0]), self.gain * (y - own[1]), nan))
