"""Counters over all processes of a robot, numbers that no robot would take, robots on standby."""

import msgspec
import numpy as np
import pytest

from agents.network.messages import PoseReceipt
from experiments.metrics.measure import measure
from experiments.recording.losses import count_in_run, lives
from experiments.recording.playback import read
from tests.experiments.recordings import PAIR, START, begun, landed, pose, seconds, state, status, whole_run, write


def _life(pid, counts):
    """Statuses of a process: at each time [s] ticks, and a tenth of that in decisions."""
    return [status(at=at, pid=pid, ticks=ticks, decisions=ticks // 10) for at, ticks in counts]


def _ticks(statuses, end=20.0):
    ordered = sorted(statuses, key=lambda each: each.stamp)
    return count_in_run(ordered, "ticks", START, START + end)


def test_counters_of_all_lives_are_added():
    first, second = _life(7, [(1.0, 100), (9.0, 900)]), _life(8, [(12.0, 50), (20.0, 850)])
    assert _ticks([*first, *second]) == 900 + 850


def test_counters_end_with_the_run():
    assert _ticks(_life(7, [(19.5, 1950), (20.5, 2050)])) == 2000
    assert _ticks(_life(7, [(19.5, 1950)])) == 1950
    assert (
        _ticks(_life(7, [(-0.5, 4000), (0.5, 50), (20.5, 2050)])) == 2000
    )  # ticks before the start are no ticks of it


def test_two_processes_of_one_robot_report_in_turn():
    turns = [*_life(7, [(k, 100 * k) for k in range(1, 21)]), *_life(8, [(k + 0.5, 10 * k) for k in range(1, 20)])]
    assert _ticks(turns) == 2000 + 190


def test_a_process_number_is_given_again():
    again = [*_life(1, [(1.0, 100), (9.0, 900)]), *_life(1, [(12.0, 50), (20.0, 850)])]
    assert [len(life) for life in lives(again, lambda each: each.decisions)] == [2, 2]
    assert _ticks(again) == 900 + 850


def test_a_clock_set_back_is_no_restart():
    mixed = _life(7, [(8.0, 800), (9.0, 900), (8.5, 1000), (9.5, 1100), (20.0, 2150)])
    assert _ticks(mixed) == 2150


@pytest.mark.parametrize("seq", [2**63 - 1, 2**53, 0, -5])
def test_forged_running_numbers_count_nowhere(path, seq):
    receipt = PoseReceipt("TB01", seq, START + 0.5, START + 0.51, (9.0, 9.0, 0.0), (0.0, 0.0, 0.0))
    forged = [pose("TB01", seq, 0.5501), state("CF01", 99, 0.555, -0.555, received=[receipt])]
    write(path, *whole_run(), *forged)
    trace = read(path).trace
    assert trace.sent.seq.tolist() == list(range(1, 11))
    assert measure(trace).robots[0].messages == 10
    assert 9.0 not in trace.received.position


def test_forged_counters_count_nowhere(path):
    forged = status("CF01", at=0.9, ticks=2**60, missed=2**61, lost={"TB01": 2**62}, pid=66)
    write(path, *whole_run(), forged)
    whole = read(path).trace
    assert (whole.ticks.tolist(), whole.missed_deadlines.tolist(), whole.lost.tolist()) == ([100, 99], [3, 0], [1, 0])


def test_share_of_missed_deadlines_stays_below_one(path):
    late = [msgspec.structs.replace(each, missed=300) for each in _life(7, [(1.0, 100)])]
    write(path, *whole_run()[:-2], *late)
    assert measure(read(path).trace).robots[0].missed_share == pytest.approx(0.75)


RESERVE = msgspec.structs.replace(
    PAIR, duration_s=4.0, robots=PAIR.robots | {"KH01": msgspec.structs.replace(PAIR.robots["TB01"], standby=True)}
)
LINKED = msgspec.structs.replace(
    RESERVE, formation=msgspec.structs.replace(PAIR.formation, links={"TB01 - CF01": 1.0, "TB01 - KH01": 1.0})
)


def test_reserve_that_never_came_is_left_out(path):
    write(path, begun(), *seconds(41), landed(4.0), experiment=LINKED)
    trace = read(path).trace
    assert trace.robots == ("TB01", "CF01")
    assert not measure(trace).failures


def test_reserve_is_judged_since_it_came(path):
    came = [state("KH01", k, k / 10, 1.0, phase="running" if k >= 15 else "ready") for k in range(10, 41)]
    came += [pose("KH01", k, k / 10) for k in range(13, 40)]  # two before it took part
    write(path, begun(), *seconds(41), *came, landed(4.0), experiment=LINKED)
    trace = read(path).trace
    np.testing.assert_allclose(trace.joined, [0.0, 0.0, 1.5], atol=1e-6)
    measured = measure(trace)
    added = measured.robots[2]
    assert (added.known, added.coverage, measured.died, measured.failures) == (1.0, 1.0, (), ())
    assert added.f_hz == pytest.approx(25 / 2.5)
    assert measured.robots[0].coverage == 1.0
