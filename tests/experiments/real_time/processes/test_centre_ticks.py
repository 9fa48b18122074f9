"""Decisions of the central controller on a simulated clock: half a tick after their time, at the robots' instants."""

import pytest

from agents.network.keys import Keys
from agents.network.name_ownership import OwnershipCheck
from experiments.definition.plan import Plan
from experiments.real_time.processes.centre import CentreProcess
from experiments.real_time.processes.joining import Network
from tests.agents.few import pair
from tests.fuzz.loopnet import Net

KEYS = Keys("park")
BEGIN = 1000.0


class Over:
    """Event whose waits advance a simulated clock, the sixth by `more` [s] than asked; set after so many."""

    def __init__(self, waits, more=0.0):
        self.now, self._left, self._sixth, self._more = BEGIN, waits, waits - 6, more

    def is_set(self):
        return self._left < 0

    def wait(self, seconds):
        self._left -= 1
        self.now += seconds + (self._more if self._left == self._sixth else 0.0)
        return self.is_set()


def test_decisions_follow_start_and_skip_standstill(monkeypatch):
    over, decided = Over(12), []
    with Net().worn() as net:
        experiment = pair(architecture="centralised")
        joint = Network(net.session, KEYS, [], [], OwnershipCheck([KEYS.centre_alive]))
        process = CentreProcess(Plan(experiment), joint, clock=lambda: over.now)
        hz = experiment.rates.coordination_hz

        def decide(t, _phase, start):
            decided.append((round(t * hz, 6), round((over.now - BEGIN) * hz, 6)))
            if len(decided) == 3:
                for row in process.guided:
                    start[row] = 4.25 / hz  # robots began there
            over.now += (3.9 if len(decided) == 8 else 0.1) / hz
            return []

        monkeypatch.setattr(process.centre, "decide", decide)
        process.run(over)
    late = 0.5 * hz / experiment.rates.body_hz
    times = [0, 1, 2, 3, 3.25, 4.25, 5.25, 6.25, 9.25, 10.25, 11.25, 12.25]
    assert [t for t, _ in decided] == pytest.approx(times)
    delays = [at - t for t, at in decided]
    assert delays == pytest.approx([late if t != 9.25 else 6.25 + late + 3.9 - 9.25 for t in times])
    assert process.missed == 2
    assert process.ticks.next == pytest.approx(13.25 / hz)


def test_long_wait_decides_for_no_past_instant(monkeypatch):
    over, decided, late = Over(12, more=0.73), [], []
    with Net().worn() as net:
        experiment = pair(architecture="centralised")
        joint = Network(net.session, KEYS, [], [], OwnershipCheck([KEYS.centre_alive]))
        process = CentreProcess(Plan(experiment), joint, clock=lambda: over.now)
        hz = experiment.rates.coordination_hz

        def decide(t, *_):
            decided.append(over.now - BEGIN - t)
            late.append(process.late_s)
            return []

        monkeypatch.setattr(process.centre, "decide", decide)
        process.run(over)
    assert len(decided) == 12
    assert max(decided) < 1.0 / hz + process.patience_s
    assert process.missed == int(0.73 * hz)
    assert max(late) == pytest.approx(0.73, abs=1e-9)
