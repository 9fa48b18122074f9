"""One clock for everybody: read once, shared by the processes of a machine, and slewed."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.clock import SLEW, STEP_S, Clock, correction_line, uptime
from experiments.real_time.hosts.launcher import Launcher
from tests.commands import ROOT


class Machine:
    """Clocks of a machine: the wall clock, and those that go on or stand while it sleeps [s]."""

    def __init__(self, monkeypatch):
        self.wall, self.up = 1000.0, {time.CLOCK_BOOTTIME: 50.0, time.CLOCK_MONOTONIC: 5.0}
        monkeypatch.setattr(time, "time", lambda: self.wall)
        monkeypatch.setattr(time, "clock_gettime", lambda clock: self.up[clock])


def test_step_of_the_wall_clock_moves_nothing(monkeypatch):
    machine = Machine(monkeypatch)
    clock = Clock(0.5)
    machine.wall -= 3600.0
    machine.up[time.CLOCK_BOOTTIME] = 52.0
    assert clock.utc() == clock.at(52.0) == 1002.5
    assert clock.at(49.0) == 999.5


def test_clock_goes_on_while_machine_sleeps(monkeypatch):
    machine = Machine(monkeypatch)
    clock = Clock()
    machine.up[time.CLOCK_BOOTTIME] += 3600.0
    assert clock.utc() == 1000.0 + 3600.0


# of reports, figures and the live view: no robot moves by them
DATES = {
    "experiments/report/report.py",
    "experiments/run.py",
    "experiments/sweep/page.py",
    "experiments/view/acting.py",
    "experiments/view/gate.py",
    "experiments/view/live.py",
}


def test_no_process_reads_the_wall_clock_itself():
    found = []
    for folder in ("agents", "bridges", "twins", "experiments"):
        for file in (ROOT / folder).rglob("*.py"):
            if file.relative_to(ROOT).as_posix() not in DATES:
                found += [line for line in file.read_text().splitlines() if "time.time" in line]
    assert [line for line in found if "= time.time() - " not in line] == []


def test_later_process_reads_the_same_clock(tmp_path, monkeypatch):
    launcher = Launcher(tmp_path)
    launcher.clock = first = Clock()
    environments = []
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
    clock, now, stamps = Clock(-0.2), 0.0, []
    clock.follow(correction_line(-0.23).strip())
    for _ in range(1000):
        now += 0.01
        clock.slew(0.01)
        stamps.append(now + clock.correction_s)
    steps = np.diff(stamps)
    assert clock.correction_s == -0.23
    assert steps.min() == pytest.approx(0.01 * (1 - SLEW))
    assert steps.max() == pytest.approx(0.01)
    assert (steps < 0.009999).sum() == pytest.approx(0.03 / SLEW / 0.01, abs=2), "6 s for 30 ms"
    assert clock.slew(0.01) == 0.0


@pytest.mark.parametrize(
    "line", [b"clock", b"clock nan", b"clock inf", b"clock 0.8", b"0.1", b"clock 0.1 0.2", b"\xff" * 80]
)
def test_nonsense_and_jumps_are_not_followed(line, capsys):
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
