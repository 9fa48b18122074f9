"""Robots with a turn of the wrong sign end a run, with the probable cause; right ones raise no alarm."""

import pytest

from agents.safety.hazards import Cause, failed
from experiments.file import document
from tests.experiments.virtual_time.evaluators import evaluated
from twins.models.differential import Differential


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turn_of_the_wrong_sign_fails_a_run(sign, monkeypatch):
    right = Differential.command
    monkeypatch.setattr(Differential, "command", lambda self, s: right(self, (s[0], sign * s[1], s[2], s[3])))
    log, _ = evaluated(document.load("triangle").cases()["event"].experiment, compiled=False)
    found = {row: each for row, each in log.incidents if each.cause == Cause.STRAYING}
    assert sorted(found) == ([] if sign > 0.0 else [0, 1])
    for each in found.values():
        assert failed(each.text)
        assert each.text.endswith("is the sign of its turn wrong, are its wheels swapped?")
