"""Age of the picture of a live page, and how many pictures it gets."""

from __future__ import annotations

import pytest

from experiments.view.heartbeat import RECORDED_S, SLOWEST_S, DataAge, frame_s, mark


def test_age_is_unknown_before_the_first_pose():
    assert DataAge().seconds(1000.0, 0.0) is None


def test_poses_that_came_late_are_old():
    age = DataAge()
    age.add(1000.0, utc=1000.1, now=10.0)
    assert age.seconds(1000.1, 10.0) == pytest.approx(0.1)
    age.add(1001.0, utc=1046.0, now=56.0)  # 45 s in a queue
    assert age.seconds(1046.0, 56.0) == pytest.approx(45.0)
    assert not age.recorded


def test_silence_makes_poses_old():
    age = DataAge()
    age.add(1000.5, utc=1000.0, now=10.0)  # a clock ahead by half a second
    assert age.seconds(1133.0, 143.0) == pytest.approx(133.0)


def test_recordings_are_as_old_as_their_delay_grew():
    age = DataAge()
    age.add(1000.0, utc=1000.0 + 86400.0, now=10.0)
    assert age.recorded
    assert age.seconds(1000.0 + 86400.0, 10.0) == 0.0
    assert age.seconds(1000.0 + 86403.0, 13.0) == pytest.approx(3.0)
    assert RECORDED_S < 86400.0


def test_mark_escapes_and_states_the_time():
    text = mark(3, 1000.0, 0.25, "<b>'", over=True)
    assert "data-stage='3'" in text
    assert "data-picture='999.750'" in text
    assert "<b>" not in text
    assert "data-picture=''" in mark(3, 1000.0, None)


def test_slow_pages_get_fewer_pictures():
    periods = [frame_s(lag, 0.04) for lag in (0.0, 1.0, 2.0, 3.0, 100.0)]
    assert periods[:2] == [0.04, 0.04]
    assert periods == sorted(periods)
    assert periods[-1] == SLOWEST_S
