"""Whether an external robot flies, by its heights and orders alone."""

from math import inf

import pytest

from agents.vectors import UNKNOWN
from bridges.measured_flight import GROUNDED_S, LANDING_S, MeasuredFlight

DT = 0.1


class Seen(MeasuredFlight):
    """A robot that is measured all the time."""

    def __init__(self, start, to=None, seconds=4.0):
        super().__init__()
        self.now, self.at, self.climbing = 0.0, start, False
        self.take_off(start)
        if to is not None:
            self.go(to, seconds)

    def go(self, to, seconds):
        """Fly to a place in so long; returns whether the flight is over."""
        velocity = tuple((there - here) / seconds for there, here in zip(to, self.at, strict=True))
        for _ in range(round(seconds / DT)):
            self.now += DT
            self.at = tuple(here + DT * speed for here, speed in zip(self.at, velocity, strict=True))
            self.update(self.now, self.now, self.at, velocity, climbing=self.climbing)
        return not self.flying

    def stay(self, seconds):
        return self.go(self.at, seconds)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.08), (0.0, 0.0, 0.7)])
def test_flight_from_floor_or_table_ends_in_place(start):
    seen = Seen(start)
    assert not seen.go((0.0, 0.0, 1.2), 2.0)
    assert not seen.go((1.0, 0.0, 1.2), 5.0)
    assert not seen.go((0.0, 0.0, 1.2), 5.0)
    seen.land(seen.now)
    assert not seen.go((start[0], start[1], start[2] + 0.06), 2.0)
    assert seen.go(start, 0.5) or seen.stay(0.2)


def test_slow_flight_below_its_table_goes_on():
    seen = Seen((0.0, 0.0, 0.7), to=(0.0, 0.0, 1.0))
    seen.go((1.0, 0.0, 0.4), 4.0)
    assert not seen.stay(20.0)
    seen.go((1.0, 0.0, 0.7), 4.0)
    assert not seen.stay(20.0)  # as high as its table, beside it
    seen.go((1.0, 0.0, 0.0), 4.0)
    assert seen.stay(GROUNDED_S + 0.2)


def test_landing_on_another_table_ends():
    seen = Seen((0.0, 0.0, 0.0), to=(1.0, 0.0, 1.2))
    seen.land(seen.now)
    seen.go((1.0, 0.0, 0.7), 2.0)
    assert not seen.stay(LANDING_S - 1.0)
    assert seen.stay(1.5)


def test_hover_that_refuses_to_land_goes_on():
    seen = Seen((0.0, 0.0, 0.0), to=(0.0, 0.0, 1.2))
    seen.land(seen.now)
    assert not seen.stay(60.0)


def test_repeated_landing_keeps_its_time():
    flight = MeasuredFlight()
    flight.take_off(UNKNOWN)
    over = []
    for step in range(round((LANDING_S + 1.0) / DT)):
        now = step * DT
        flight.land(now)
        over.append(flight.update(now, -inf, UNKNOWN, UNKNOWN, climbing=False))
    assert over.index(True) == pytest.approx(LANDING_S / DT, abs=2)


def test_stands_before_it_rises():
    seen = Seen((0.0, 0.0, 0.0))
    seen.climbing = True
    assert not seen.stay(30.0)
    seen.climbing = False
    assert seen.stay(GROUNDED_S + 0.2)
