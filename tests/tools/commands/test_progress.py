"""What the terminal shows of a run."""

from __future__ import annotations

import time

import pytest

from agents.network import messages
from experiments.real_time.conductor.run_view import Progress, RobotView
from tools.progress import Lines, Table


@pytest.mark.parametrize("kind", [Lines, Table])
def test_errors_from_before_routers_silence_are_no_news(
    kind: type[Lines | Table], capsys: pytest.CaptureFixture[str]
) -> None:
    progress = Progress("event", "formation", 4.0, 15.0, {"KH01": RobotView(error=0.123)})
    with kind() as show:
        show(progress)
    assert "0.123" in capsys.readouterr().err or kind is Table
    progress.silent_since = time.monotonic() - 2.0
    with kind() as show:
        show(progress)
    said = capsys.readouterr().err
    assert "no router answers for 2.0 s" in said
    assert "error [m]" not in said


def test_hazard_is_printed_with_its_beginning(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress("event", "formation", 9.0, 15.0, {})
    stamp = progress.clock.utc()
    progress.events += [
        messages.Event(stamp - 0.5, "hazard", "Q1", "hold: its own position is lost"),
        messages.Event(stamp, "phase", "conductor", "formation"),
    ]
    with Lines() as show:
        show(progress)
    hazard, phase, *_ = capsys.readouterr().err.splitlines()
    assert hazard == "event: hazard Q1: hold: its own position is lost (at 8.5 s)"
    assert phase == "event: phase conductor: formation"
