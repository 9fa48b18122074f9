"""Whether an external robot flies, by its heights and orders alone."""

import numpy as np
import pytest

from bridges.measured_flight import GROUNDED_S, LANDING_S, MeasuredFlight

DT = 0.1


class Seen:
    """One robot that is measured all the time."""

    def __init__(self, start):
        self.flight, self.now, self.at = MeasuredFlight(1), 0.0, np.array(start, dtype=float)
        self.flight.take_off(0, self.at)
        self.climbing = np.array([False])

    def go(self, to, seconds):
        """Fly to a place in so long; returns whether the flight is over."""
        steps = round(seconds / DT)
        velocity = (np.array(to) - self.at) / seconds
        for _ in range(steps):
            self.now, self.at = self.now + DT, self.at + DT * velocity
            self.flight.update(self.now, np.array([self.now]), self.at[None], velocity[None], self.climbing)
        return not self.flight.flying[0]

    def stay(self, seconds):
        return self.go(self.at.copy(), seconds)

    def land(self):
        self.flight.land(0, self.now)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.08), (0.0, 0.0, 0.7)])
def test_flight_from_floor_or_table_ends_at_its_place(start):
    seen = Seen(start)
    assert not seen.go((0.0, 0.0, 1.2), 2.0)
    assert not seen.go((1.0, 0.0, 1.2), 5.0)
    assert not seen.go((0.0, 0.0, 1.2), 5.0)
    seen.land()
    assert not seen.go((start[0], start[1], start[2] + 0.06), 2.0)
    assert seen.go(start, 0.5) or seen.stay(0.2)


def test_slow_flight_below_its_table_goes_on():
    seen = Seen((0.0, 0.0, 0.7))
    seen.go((0.0, 0.0, 1.0), 2.0)
    seen.go((1.0, 0.0, 0.4), 4.0)
    assert not seen.stay(20.0)
    seen.go((1.0, 0.0, 0.7), 4.0)
    assert not seen.stay(20.0)  # as high as its table, beside it
    seen.go((1.0, 0.0, 0.0), 4.0)
    assert seen.stay(GROUNDED_S + 0.2)


def test_landing_on_another_table_ends():
    seen = Seen((0.0, 0.0, 0.0))
    seen.go((1.0, 0.0, 1.2), 4.0)
    seen.land()
    seen.go((1.0, 0.0, 0.7), 2.0)
    assert not seen.stay(LANDING_S - 1.0)
    assert seen.stay(1.5)


def test_hover_that_refuses_to_land_goes_on():
    seen = Seen((0.0, 0.0, 0.0))
    seen.go((0.0, 0.0, 1.2), 4.0)
    seen.land()
    assert not seen.stay(60.0)


def test_repeated_landing_keeps_its_time():
    flight = MeasuredFlight(1)
    flight.take_off(0, np.full(3, np.nan))
    over = []
    for step in range(round((LANDING_S + 1.0) / DT)):
        now = step * DT
        flight.land(0, now)
        unseen = np.full((1, 3), np.nan)
        over += flight.update(now, np.array([-np.inf]), unseen, unseen, np.array([False])).tolist()
    assert over.index(True) == pytest.approx(LANDING_S / DT, abs=2)


def test_stands_before_it_rises():
    seen = Seen((0.0, 0.0, 0.0))
    seen.climbing[:] = True
    assert not seen.stay(30.0)
    seen.climbing[:] = False
    assert seen.stay(GROUNDED_S + 0.2)
