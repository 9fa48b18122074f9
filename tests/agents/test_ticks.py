"""Ticks of a loop on a simulated clock: when they are due, which are skipped, and that they keep their times."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.ticks import Ticks

PERIOD = 0.125  # [s] of which all multiples are exact
BEGIN = 1000.0


class Loop:
    """Loop whose waits last as long as they shall, plus `oversleeps`, and whose ticks take `works` [s]."""

    def __init__(self, **chosen):
        self.now = BEGIN
        self.ticks = Ticks(1.0 / PERIOD, clock=lambda: self.now, **chosen)
        self.times, self.skipped, self.begun = [], [], []

    def turn(self, works=0.0, oversleeps=0.0):
        wait = self.ticks.until_next()
        self.now += wait + (oversleeps if wait else 0.0)
        self.skipped.append(self.ticks.begin())
        self.times.append(self.ticks.t)
        self.begun.append(self.ticks.elapsed())
        self.now += works
        return self


def test_ticks_in_time_begin_at_their_times():
    loop = Loop()
    for _ in range(5):
        loop.turn(works=0.8 * PERIOD)
    assert loop.times == loop.begun == [k * PERIOD for k in range(5)]
    assert not any(loop.skipped)
    assert loop.ticks.until_next() == pytest.approx(0.2 * PERIOD)


@pytest.mark.parametrize(("works", "skipped", "late"), [(1.75, 0, 0.75), (2.0, 1, 0.0), (4.25, 3, 0.25)])
def test_late_loop_skips_ticks_that_are_over(works, skipped, late):
    loop = Loop().turn(works=works * PERIOD).turn()
    assert loop.skipped == [0, skipped]
    assert loop.times == [0.0, (1 + skipped) * PERIOD]
    assert loop.ticks.late_s == late * PERIOD
    assert loop.turn().begun[-1] == (2 + skipped) * PERIOD, "in time again"


def test_few_ticks_are_made_up_for():
    loop = Loop(catch_up=3).turn(works=6.0 * PERIOD)
    for _ in range(5):
        loop.turn()
    assert loop.skipped == [0, 2, 0, 0, 0, 0]
    assert loop.times == [0.0, *(k * PERIOD for k in range(3, 8))]
    assert loop.begun == [0.0, *(k * PERIOD for k in (6, 6, 6, 6, 7))]


def test_long_wait_delays_and_skips_none():
    loop = Loop().turn().turn(oversleeps=1.5 * PERIOD).turn().turn()
    assert loop.skipped == [0, 0, 0, 0]
    assert loop.begun == [0.0, 2.5 * PERIOD, 2.5 * PERIOD, 3.0 * PERIOD]


def test_second_wait_skips_from_the_present():
    loop = Loop()
    loop.turn()
    loop.now += 2.5 * PERIOD
    assert loop.ticks.until_next() == 0.0
    loop.now += 8.0 * PERIOD  # such as for the ownership of a name
    loop.turn()
    assert loop.skipped[-1] == 9
    assert loop.times[-1] == 10 * PERIOD


def test_time_follows_a_slewed_clock():
    loop = Loop()
    loop.now += 60.0
    assert loop.ticks.start() == BEGIN + 60.0
    loop.turn().turn()
    loop.ticks.zero -= 0.25 * PERIOD
    assert loop.ticks.elapsed() == 1.25 * PERIOD
    assert loop.turn().begun[-1] == 2.0 * PERIOD
    assert loop.now == BEGIN + 60.0 + 1.75 * PERIOD


@pytest.mark.parametrize(("at", "following"), [(5.4, 1.4), (5.0, 2.0), (1.01, 1.01), (0.3, 1.3)])
def test_aligned_ticks_fall_on_a_time(at, following):
    loop = Loop().turn().turn()  # at 0 and 1
    loop.ticks.align(at * PERIOD)
    assert loop.ticks.next == pytest.approx(following * PERIOD)
    assert loop.turn().begun[-1] == pytest.approx(following * PERIOD)


@given(st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 5.0)), max_size=40), st.integers(0, 4))
def test_each_tick_is_begun_or_skipped_once(delays, catch_up):
    loop = Loop(catch_up=catch_up)
    for works, oversleeps in delays:
        before = loop.ticks.next
        late = loop.now - BEGIN - before
        loop.turn(works * PERIOD, oversleeps * PERIOD)
        assert loop.times[-1] == before + loop.skipped[-1] * PERIOD
        assert loop.begun[-1] >= loop.times[-1]
        assert late - loop.skipped[-1] * PERIOD < (catch_up + 1) * PERIOD
