"""Messages that no recording should change by: lives of processes, forged numbers, standby, repetitions, odd places."""

import numpy as np
import pytest
from msgspec.structs import replace

from agents.network.messages import Pose, PoseReceipt, State
from experiments.definition.experiment import Formation
from experiments.metrics.measure import measure
from experiments.recording.losses import count_in_run
from experiments.recording.playback import read
from experiments.run import reopen
from tests.experiments import recordings as rec


def life(pid, *counts):
    """Statuses of a process: at each time [s] ticks, and a tenth of that in decisions."""
    return [rec.status(at=at, pid=pid, ticks=ticks, decisions=ticks // 10) for at, ticks in counts]


EVERY_SECOND = [(float(k), 100 * k) for k in range(1, 21)]
BETWEEN = [(k + 0.5, 10 * k) for k in range(1, 20)]


@pytest.mark.parametrize(
    ("said", "ticks"),
    [
        ([*life(7, (1.0, 100), (9.0, 900)), *life(8, (12.0, 50), (20.0, 850))], 900 + 850),
        ([*life(1, (1.0, 100), (9.0, 900)), *life(1, (12.0, 50), (20.0, 850))], 900 + 850),
        (life(7, (19.5, 1950), (20.5, 2050)), 2000),
        (life(7, (19.5, 1950)), 1950),
        (life(7, (-0.5, 4000), (0.5, 50), (20.5, 2050)), 2000),
        ([*life(7, *EVERY_SECOND), *life(8, *BETWEEN)], 2000 + 190),
        (life(7, (8.0, 800), (9.0, 900), (8.5, 1000), (9.5, 1100), (20.0, 2150)), 2150),
    ],
    ids=[
        "another process", "process number given again", "beyond the end", "until shortly before the end",
        "before the start", "two processes in turn", "clock set back",
    ],
)  # fmt: skip
def test_counters_of_all_lives_in_the_run(said, ticks):
    ordered = sorted(said, key=lambda each: each.stamp)
    assert count_in_run(ordered, "ticks", rec.START, rec.START + 20.0) == ticks


@pytest.mark.parametrize("seq", [2**63 - 1, 2**53, 0, -5])
def test_forged_running_numbers_count_nowhere(path, seq):
    receipt = PoseReceipt("TB01", seq, rec.START + 0.5, rec.START + 0.51, (9.0, 9.0, 0.0), (0.0, 0.0, 0.0))
    forged = [rec.pose("TB01", seq, 0.5501), rec.state("CF01", 99, 0.555, -0.555, received=[receipt])]
    rec.write(path, *rec.whole_run(), *forged)
    trace = read(path).trace
    assert trace.sent.seq.tolist() == list(range(1, 11))
    assert measure(trace).robots[0].messages == 10
    assert 9.0 not in trace.received.position


def test_forged_counters_count_nowhere(path):
    forged = rec.status("CF01", at=0.9, ticks=2**60, missed=2**61, lost={"TB01": 2**62}, pid=66)
    rec.write(path, *rec.whole_run(), forged)
    whole = read(path).trace
    assert (whole.ticks.tolist(), whole.missed_deadlines.tolist(), whole.lost.tolist()) == ([100, 99], [3, 0], [1, 0])


def test_share_of_missed_deadlines_stays_below_one(path):
    rec.write(path, *rec.whole_run()[:-2], rec.status(ticks=100, missed=300))
    assert measure(read(path).trace).robots[0].missed_share == pytest.approx(0.75)


STANDBY = {"KH01": replace(rec.PAIR.robots["TB01"], standby=True)}
LINKED = rec.pair_with(
    duration_s=4.0, robots=rec.PAIR.robots | STANDBY,
    formation=Formation(links={"TB01 - CF01": 1.0, "TB01 - KH01": 1.0}),
)  # fmt: skip


def test_reserve_that_never_came_is_left_out(path):
    rec.write(path, rec.begun(), *rec.seconds(41), rec.landed(4.0), experiment=LINKED)
    trace = read(path).trace
    assert trace.robots == ("TB01", "CF01")
    assert not measure(trace).failures


def test_reserve_is_judged_since_it_came(path):
    came = [rec.state("KH01", k, k / 10, 1.0, phase="running" if k >= 15 else "ready") for k in range(10, 41)]
    came += [rec.pose("KH01", k, k / 10) for k in range(13, 40)]  # two before it took part
    rec.write(path, rec.begun(), *rec.seconds(41), *came, rec.landed(4.0), experiment=LINKED)
    trace = read(path).trace
    np.testing.assert_allclose(trace.joined, [0.0, 0.0, 1.5], atol=1e-6)
    measured = measure(trace)
    added = measured.robots[2]
    assert (added.known, added.coverage, measured.died, measured.failures) == (1.0, 1.0, (), ())
    assert added.f_hz == pytest.approx(25 / 2.5)
    assert measured.robots[0].coverage == 1.0


def figures(path, *messages):
    rec.write(path, *messages)
    case = measure(read(path).trace)
    of_robots = [(robot.iae, robot.messages, robot.received, robot.known) for robot in case.robots]
    return of_robots, case.deliveries, case.lost


@pytest.fixture
def whole(tmp_path):
    return figures(tmp_path / "whole.mcap", *rec.whole_run())


def is_state(message):
    return isinstance(message, State)


RUN = rec.whole_run()
DOUBLED = {
    "all twice": [each for each in RUN for _ in range(2)],
    "receipts thrice": [replace(each, received=each.received * 3) if is_state(each) else each for each in RUN],
    "robots of no experiment": [*RUN, *[replace(each, robot="XX99") for each in RUN if isinstance(each, State | Pose)]],
    "second start": [*RUN, rec.begun(0.5)],
}


@pytest.mark.parametrize("messages", DOUBLED.values(), ids=DOUBLED)
def test_repeated_and_foreign_messages_change_no_figure(path, whole, messages):
    assert figures(path, *messages) == whole


@pytest.mark.parametrize("place", [(1e300, 0.0, 0.0), (float("nan"),) * 3, (float("inf"), 0.0, 0.0)])
def test_impossible_places_are_unknown(path, whole, place):
    known = [
        each for each in RUN if is_state(each) and each.robot == "TB01" and abs(each.stamp - rec.START - 0.5) < 0.01
    ]
    odd = {id(each): replace(each, position=place, true_position=place) for each in known}
    found = figures(path, *[odd.get(id(each), each) for each in RUN])
    assert len(odd) == 1
    assert found[0][0][0] == pytest.approx(whole[0][0][0])  # a hole of less than a second is drawn over
    assert found[1:] == whole[1:]


def test_recording_that_broke_off_late_is_interrupted(path):
    rec.write(path, rec.begun(), *rec.seconds(7))  # 0.4 s before its end, without a word of a landing
    broken = measure(read(path).trace)
    assert broken.interrupted
    assert broken.duration_s == pytest.approx(0.6, abs=0.11)  # within a sample


def test_robots_that_landed_by_themselves_are_whole(path):
    rec.write(path, rec.begun(), *rec.seconds(7), rec.state("TB01", 9, 1.5, phase="landing"))
    assert not measure(read(path).trace).interrupted


def test_two_recordings_of_one_case_are_told(tmp_path):
    for name in ("only", "only-recovered"):
        rec.write(tmp_path / f"{name}.mcap", *rec.whole_run())
    rec.write(tmp_path / "other.mcap", rec.begun(), *rec.seconds(11), rec.landed(), case="other", seed=9)
    notes = " ".join(reopen(tmp_path).notes)
    assert "only: several recordings are of this case; shown is only-recovered.mcap" in notes
    assert "different seeds: only 4, other 9" in notes
