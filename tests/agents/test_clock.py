"""One clock for everybody: read once, shared by the processes of a machine, and slewed; and the ticks of a loop."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.clock import SLEW, STEP_S, Clock, correction_line, uptime
from agents.ticks import Ticks
from experiments.real_time.hosts.launcher import Launcher
from tests.cases import for_each
from tests.commands import ROOT


def test_steps_of_the_wall_clock_move_nothing(monkeypatch):
    wall, up = [1000.0], {time.CLOCK_BOOTTIME: 50.0, time.CLOCK_MONOTONIC: 5.0}
    monkeypatch.setattr(time, "time", lambda: wall[0])
    monkeypatch.setattr(time, "clock_gettime", lambda clock: up[clock])
    clock = Clock(0.5)
    wall[0] -= 3600.0
    up[time.CLOCK_BOOTTIME] = 52.0
    assert clock.utc() == clock.at(52.0) == 1002.5
    assert clock.at(49.0) == 999.5
    up[time.CLOCK_BOOTTIME] += 3600.0  # the machine slept
    assert clock.utc() == 1002.5 + 3600.0


# of reports, figures and the live view: no robot moves by them
DATES = {"report/report.py", "run.py", "sweep/page.py", "view/acting.py", "view/gate.py", "view/live.py"}


def test_no_process_reads_the_wall_clock_itself():
    files = {file for folder in ("agents", "bridges", "twins", "experiments") for file in (ROOT / folder).rglob("*.py")}
    found = []
    for file in files - {ROOT / "experiments" / name for name in DATES}:
        found += [line for line in file.read_text().splitlines() if "time.time" in line]
    assert [line for line in found if "= time.time() - " not in line] == []


def test_later_process_reads_the_same_clock(tmp_path, monkeypatch):
    launcher, environments = Launcher(tmp_path), []
    launcher.clock = first = Clock()
    monkeypatch.setattr(launcher, "spawn", lambda name, command, environment: environments.append(environment))
    launcher.start("CF01", "experiments.real_time.processes.robot")
    wall = time.time
    monkeypatch.setattr(time, "time", lambda: wall() + 60.0)
    assert Clock().utc() > first.utc() + 59.0, "on a machine of its own"
    for name, value in environments[0].items():
        monkeypatch.setenv(name, value)
    now = uptime()
    assert Clock().at(now) == pytest.approx(first.at(now), abs=1e-6)
    assert Clock(-0.2).at(now) == pytest.approx(first.at(now) - 0.2, abs=1e-6)


def test_clock_follows_smoothly_and_never_back():
    clock, stamps = Clock(-0.2), []
    clock.follow(correction_line(-0.23).strip())
    for k in range(1, 1001):
        clock.slew(0.01)
        stamps.append(0.01 * k + clock.correction_s)
    steps = np.diff(stamps)
    assert clock.correction_s == -0.23
    assert steps.min() == pytest.approx(0.01 * (1 - SLEW))
    assert steps.max() == pytest.approx(0.01)
    assert (steps < 0.009999).sum() == pytest.approx(0.03 / SLEW / 0.01, abs=2), "6 s for 30 ms"
    assert clock.slew(0.01) == 0.0


@pytest.mark.parametrize(
    "line", [b"clock", b"clock nan", b"clock inf", b"clock 0.8", b"0.1", b"clock 0.1 0.2", b"\xff" * 80]
)
def test_absurd_corrections_and_jumps_are_not_followed(line, capsys):
    clock = Clock(0.1)
    clock.follow(line)
    assert clock.slew(1.0) == 0.0
    assert capsys.readouterr().err.startswith("clock: ")


@given(st.binary(max_size=60) | st.floats().map(lambda number: b"clock %r" % number))
def test_slew_is_bounded_by_drift(line):
    clock = Clock(0.1)
    clock.follow(line)
    assert abs(clock.slew(1.0)) <= SLEW
    for _ in range(200):
        clock.slew(1.0)
    assert abs(clock.correction_s - 0.1) <= STEP_S


PERIOD, BEGIN = 0.125, 1000.0  # [s] all multiples of which are exact; [s]


class Loop:
    """Loop whose waits last as long as they shall, plus `oversleeps`, and whose ticks take `works`, in periods."""

    def __init__(self, **chosen):
        self.now = BEGIN
        self.ticks = Ticks(1.0 / PERIOD, clock=lambda: self.now, **chosen)
        self.times, self.skipped, self.begun = [], [], []  # in periods

    def turn(self, works=0.0, oversleeps=0.0):
        wait = self.ticks.until_next()
        self.now += wait + (oversleeps * PERIOD if wait else 0.0)
        self.skipped.append(self.ticks.begin())
        self.times.append(self.ticks.t / PERIOD)
        self.begun.append(self.ticks.elapsed() / PERIOD)
        self.now += works * PERIOD
        return self


@for_each("works, skipped, late", [(0.75, 0, 0.0), (1.75, 0, 0.75), (2.0, 1, 0.0), (4.25, 3, 0.25)])
def test_late_loop_skips_ticks_that_are_over(works, skipped, late):
    loop = Loop().turn(works=works).turn()
    assert (loop.skipped, loop.times, loop.ticks.late_s) == ([0, skipped], [0.0, 1 + skipped], late * PERIOD)
    assert loop.turn().begun[-1] == 2 + skipped, "in time again"


def test_few_ticks_are_made_up_for():
    loop = Loop(catch_up=3).turn(works=6.0)
    for _ in range(5):
        loop.turn()
    assert (loop.skipped, loop.times) == ([0, 2, 0, 0, 0, 0], [0, 3, 4, 5, 6, 7])
    assert loop.begun == [0, 6, 6, 6, 6, 7]


def test_long_wait_skips_none_unless_asked_twice():
    loop = Loop().turn().turn(oversleeps=1.5).turn().turn()
    assert (loop.skipped, loop.begun) == ([0, 0, 0, 0], [0, 2.5, 2.5, 3])
    twice = Loop().turn()
    twice.now += 2.5 * PERIOD
    assert twice.ticks.until_next() == 0.0
    twice.now += 8.0 * PERIOD  # such as for the ownership of a name
    twice.turn()
    assert (twice.skipped[-1], twice.times[-1]) == (9, 10)


def test_time_follows_a_slewed_clock():
    loop = Loop()
    loop.now += 60.0
    assert loop.ticks.start() == BEGIN + 60.0
    loop.turn().turn()
    loop.ticks.zero -= 0.25 * PERIOD
    assert loop.ticks.elapsed() == 1.25 * PERIOD
    assert (loop.turn().begun[-1], loop.now) == (2, BEGIN + 60.0 + 1.75 * PERIOD)


@pytest.mark.parametrize(("at", "following"), [(5.4, 1.4), (5.0, 2.0), (1.01, 1.01), (0.3, 1.3)])
def test_aligned_ticks_fall_on_a_time(at, following):
    loop = Loop().turn().turn()  # at 0 and 1
    loop.ticks.align(at * PERIOD)
    assert loop.ticks.next == pytest.approx(following * PERIOD)
    assert loop.turn().begun[-1] == pytest.approx(following)
