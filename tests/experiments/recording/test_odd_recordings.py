"""Recordings that broke off, were put together, or hold what no robot can have said: no figure changes unsaid."""

import msgspec
import pytest

from agents.network.messages import Pose, State
from experiments.metrics.measure import measure
from experiments.recording.playback import read
from experiments.run import reopen
from tests.experiments.recordings import START, begun, landed, seconds, state, whole_run, write


def _figures(path, *messages, **more):
    write(path, *messages, **more)
    case = measure(read(path).trace)
    return (
        [(robot.iae, robot.messages, robot.received, robot.known) for robot in case.robots],
        case.deliveries,
        case.lost,
    )


@pytest.fixture
def whole(tmp_path):
    return _figures(tmp_path / "whole.mcap", *whole_run())


def _of_leader(message, at):
    return isinstance(message, State) and message.robot == "TB01" and abs(message.stamp - START - at) < 0.01


def test_messages_recorded_twice_count_once(path, whole):
    assert _figures(path, *(message for message in whole_run() for _ in range(2))) == whole


def test_receipts_repeated_in_a_state_count_once(path, whole):
    thrice = [msgspec.structs.replace(each, received=each.received * 3) if isinstance(each, State) else each
              for each in whole_run()]  # fmt: skip
    assert _figures(path, *thrice) == whole


@pytest.mark.parametrize("place", [(1e300, 0.0, 0.0), (float("nan"),) * 3, (float("inf"), 0.0, 0.0)])
def test_impossible_places_are_unknown(path, whole, place):
    odd = [msgspec.structs.replace(each, position=place, true_position=place) if _of_leader(each, 0.5) else each
           for each in whole_run()]  # fmt: skip
    found = _figures(path, *odd)
    assert found[0][0][0] == pytest.approx(whole[0][0][0])  # a hole of less than a second is drawn over
    assert found[1:] == whole[1:]


def test_robots_of_no_experiment_count_nowhere(path, whole):
    others = [msgspec.structs.replace(each, robot="XX99") for each in whole_run() if isinstance(each, State | Pose)]
    assert _figures(path, *whole_run(), *others) == whole


def test_second_start_changes_nothing(path, whole):
    assert _figures(path, *whole_run(), begun(0.5)) == whole


def test_recording_that_broke_off_late_is_interrupted(path):
    write(path, begun(), *seconds(7))  # 0.4 s before its end, without a word of a landing
    broken = measure(read(path).trace)
    assert broken.interrupted
    assert broken.duration_s == pytest.approx(0.6, abs=0.11)  # within a sample


def test_robots_that_landed_by_themselves_are_whole(path):
    write(path, begun(), *seconds(7), state("TB01", 9, 1.5, phase="landing"))
    assert not measure(read(path).trace).interrupted


def test_two_recordings_of_one_case_are_told(tmp_path):
    for name in ("only", "only-recovered"):
        write(tmp_path / f"{name}.mcap", *whole_run())
    write(tmp_path / "other.mcap", begun(), *seconds(11), landed(), case="other", seed=9)
    notes = " ".join(reopen(tmp_path).notes)
    assert "only: several recordings are of this case; shown is only-recovered.mcap" in notes
    assert "different seeds: only 4, other 9" in notes
