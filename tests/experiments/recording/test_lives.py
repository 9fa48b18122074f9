"""Messages that no recording should change by: lives of processes, forged numbers, standby, repetitions, odd places."""

import numpy as np
import pytest
from msgspec.structs import replace

from agents.network.messages import Pose, PoseReceipt, State
from experiments.definition.experiment import Formation
from experiments.metrics.measure import measure
from experiments.recording.losses import count_in_run
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
        ([*life(1, (1.0, 100), (9.0, 900)), *life(1, (12.0, 50), (20.0, 850))], 900 + 850),  # number given again
        (life(7, (19.5, 1950), (20.5, 2050)), 2000),  # beyond the end
        (life(7, (19.5, 1950)), 1950),
        (life(7, (-0.5, 4000), (0.5, 50), (20.5, 2050)), 2000),  # before the start
        ([*life(7, *EVERY_SECOND), *life(8, *BETWEEN)], 2000 + 190),  # in turn
        (life(7, (8.0, 800), (9.0, 900), (8.5, 1000), (9.5, 1100), (20.0, 2150)), 2150),  # clock set back
    ],
)
def test_counters_of_all_lives_in_the_run(said, ticks):
    ordered = sorted(said, key=lambda each: each.stamp)
    assert count_in_run(ordered, "ticks", rec.START, rec.START + 20.0) == ticks


@pytest.mark.parametrize("seq", [2**63 - 1, 2**53, 0, -5])
def test_forged_running_numbers_count_nowhere(path, seq):
    receipt = PoseReceipt("TB01", seq, rec.START + 0.5, rec.START + 0.51, (9.0, 9.0, 0.0), (0.0, 0.0, 0.0))
    forged = [rec.pose("TB01", seq, 0.5501), rec.state("CF01", 99, 0.555, -0.555, received=[receipt])]
    trace = rec.trace_of(path, *rec.whole_run(), *forged)
    assert trace.sent.seq.tolist() == list(range(1, 11))
    assert measure(trace).robots[0].messages == 10
    assert 9.0 not in trace.received.position


def test_forged_counters_count_nowhere(path, tmp_path):
    forged = rec.status("CF01", at=0.9, ticks=2**60, missed=2**61, lost={"TB01": 2**62}, pid=66)
    whole = rec.trace_of(path, *rec.whole_run(), forged)
    assert (whole.ticks.tolist(), whole.missed_deadlines.tolist(), whole.lost.tolist()) == ([100, 99], [3, 0], [1, 0])
    most = rec.trace_of(tmp_path / "missed.mcap", *rec.whole_run()[:-2], rec.status(ticks=100, missed=300))
    assert measure(most).robots[0].missed_share == pytest.approx(0.75), "below one"


STANDBY = {"KH01": replace(rec.PAIR.robots["TB01"], standby=True)}
LINKED = rec.pair_with(
    duration_s=4.0, robots=rec.PAIR.robots | STANDBY,
    formation=Formation(links={"TB01 - CF01": 1.0, "TB01 - KH01": 1.0}),
)  # fmt: skip


def test_reserve_is_judged_since_it_came(path, tmp_path):
    never = rec.trace_of(tmp_path / "never.mcap", rec.begun(), *rec.seconds(41), rec.landed(4.0), experiment=LINKED)
    assert (never.robots, measure(never).failures) == (("TB01", "CF01"), ())
    came = [rec.state("KH01", k, k / 10, 1.0, phase="running" if k >= 15 else "ready") for k in range(10, 41)]
    came += [rec.pose("KH01", k, k / 10) for k in range(13, 40)]  # two before it took part
    trace = rec.trace_of(path, rec.begun(), *rec.seconds(41), *came, rec.landed(4.0), experiment=LINKED)
    np.testing.assert_allclose(trace.joined, [0.0, 0.0, 1.5], atol=1e-6)
    measured = measure(trace)
    first, _, added = measured.robots
    assert (added.known, added.coverage, measured.died, measured.failures) == (1.0, 1.0, (), ())
    assert (added.f_hz, first.coverage) == (pytest.approx(25 / 2.5), 1.0)


def figures(path, *messages):
    case = measure(rec.trace_of(path, *messages))
    of_robots = [(robot.iae, robot.messages, robot.received, robot.known) for robot in case.robots]
    return of_robots, case.deliveries, case.lost


@pytest.fixture
def whole(tmp_path):
    return figures(tmp_path / "whole.mcap", *RUN)


RUN = rec.whole_run()
DOUBLED = {
    "all twice": [each for each in RUN for _ in range(2)],
    "receipts thrice": [replace(each, received=each.received * 3) if isinstance(each, State) else each for each in RUN],
    "robots of no experiment": [*RUN, *[replace(each, robot="XX99") for each in RUN if isinstance(each, State | Pose)]],
    "second start": [*RUN, rec.begun(0.5)],
}


@pytest.mark.parametrize("messages", DOUBLED.values(), ids=DOUBLED)
def test_repeated_and_foreign_messages_change_no_figure(path, whole, messages):
    assert figures(path, *messages) == whole


@pytest.mark.parametrize("place", [(1e300, 0.0, 0.0), (float("nan"),) * 3])
def test_impossible_places_are_unknown(path, whole, place):
    odd = next(k for k, each in enumerate(RUN) if isinstance(each, State) and each.stamp > rec.START + 0.45)
    assert RUN[odd].robot == "TB01"
    found = figures(path, *RUN[:odd], replace(RUN[odd], position=place, true_position=place), *RUN[odd + 1 :])
    assert found[0][0][0] == pytest.approx(whole[0][0][0])  # a hole of less than a second is drawn over
    assert found[1:] == whole[1:]


def test_recording_that_broke_off_late_is_interrupted(path, tmp_path):
    """0.4 s before its end, without a word of a landing; robots that landed by themselves are whole."""
    broken = measure(rec.trace_of(path, rec.begun(), *rec.seconds(7)))
    assert (broken.interrupted, broken.duration_s) == (True, pytest.approx(0.6, abs=0.11))
    landing = rec.state("TB01", 9, 1.5, phase="landing")
    landed = rec.trace_of(tmp_path / "landed.mcap", rec.begun(), *rec.seconds(7), landing)
    assert not measure(landed).interrupted


def test_two_recordings_of_one_case_are_told(tmp_path):
    for name in ("only", "only-recovered"):
        rec.write(tmp_path / f"{name}.mcap", *rec.whole_run())
    rec.write(tmp_path / "other.mcap", rec.begun(), *rec.seconds(11), rec.landed(), case="other", seed=9)
    notes = " ".join(reopen(tmp_path).notes)
    assert "only: several recordings are of this case; shown is only-recovered.mcap" in notes
    assert "different seeds: only 4, other 9" in notes
