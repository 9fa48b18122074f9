"""One clock for everybody: what a neighbour whose clock is 0.2 s ahead does to a listener, and what sets it right."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.clock import SLEW, STEP_S, Clock, correction_line, uptime
from agents.decision.neighbours import Incoming, Neighbours
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins.predictors import HOLD, ConstantVelocity, Predictor
from experiments.real_time.hosts.launcher import Launcher

AHEAD_S = 0.2
SPEED = 0.3  # [m/s] of a neighbour along x
T = 5.0  # [s] it is heard the moment it speaks,
LATER = 1.0  # [s] and believed to be somewhere this much later


def misbelieved(stamp: float, predictor: Predictor) -> float:
    """How far the listener's belief is from that by a right stamp [m]."""
    return abs(believed(stamp, predictor) - believed(T, predictor))


def believed(stamp: float, predictor: Predictor) -> float:
    """Where along x the listener believes the neighbour to be [m]."""
    neighbours = Neighbours([Incoming(0, "B", KHEPERA4, 0.5)], 1.0)
    neighbours.mark_alive(0)
    neighbours.receive(0, (SPEED * T, 0.0, 0.0), (SPEED, 0.0, 0.0), stamp, T)
    return neighbours.all[0].place(predictor, T + LATER)[0]


def test_wrong_clock_moves_predicted_neighbours():
    assert misbelieved(T + AHEAD_S, HOLD) == 0.0, "who holds the last pose does not look at its age"
    assert misbelieved(T + AHEAD_S, ConstantVelocity()) == pytest.approx(SPEED * AHEAD_S)
    assert misbelieved(T - AHEAD_S, ConstantVelocity()) == pytest.approx(SPEED * AHEAD_S)


def test_corrected_where_stamps_are_made_it_moves_nobody(monkeypatch):
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + AHEAD_S)
    monkeypatch.setattr(time, "clock_gettime", lambda _clock: 7.0)
    assert Clock().utc() == pytest.approx(now + AHEAD_S, abs=1e-6)
    clock = Clock(-AHEAD_S)
    assert misbelieved(T + clock.utc() - now, ConstantVelocity()) < 1e-6


def test_step_of_the_wall_clock_moves_nothing(monkeypatch):
    wall, steady = 1000.0, 5.0
    monkeypatch.setattr(time, "time", lambda: wall)
    monkeypatch.setattr(time, "clock_gettime", lambda _clock: steady)
    clock = Clock(0.5)
    wall, steady = 1000.0 - 3600.0, 7.0
    assert clock.utc() == clock.at(7.0) == 1002.5
    assert clock.at(4.0) == 999.5


def test_clock_goes_on_while_machine_sleeps(monkeypatch):
    up = {time.CLOCK_BOOTTIME: 50.0, time.CLOCK_MONOTONIC: 5.0}
    monkeypatch.setattr(time, "clock_gettime", up.__getitem__)
    monkeypatch.setattr(time, "monotonic", lambda: up[time.CLOCK_MONOTONIC])
    clock = Clock()
    before = clock.utc()
    up[time.CLOCK_BOOTTIME] += 3600.0
    assert clock.utc() - before == 3600.0


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
    root = Path(__file__).resolve().parents[2]
    readers = {
        file: [line.strip() for line in file.read_text().splitlines() if "time.time" in line]
        for folder in ("agents", "bridges", "twins", "experiments")
        for file in sorted((root / folder).rglob("*.py"))
        if file.relative_to(root).as_posix() not in DATES
    }
    once = [line for lines in readers.values() for line in lines if "= time.time() - " not in line]
    assert once == []


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
