"""Pace of world and central controller on a simulated clock: lateness is caught up, time of a standstill is lost."""

import threading
import types

import pytest

from experiments.real_time.processes import world as world_module
from experiments.real_time.processes import world_network
from experiments.real_time.processes.world_population import WorldBodies
from tests.experiments.real_time.processes.joined import centre, joined_world, world_plan
from tests.network import Net

BEGIN, WORLD_HZ = 1000.0, 100.0


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


def decisions(monkeypatch, over, decide):
    """The central controller after a run in which `decide` gets it, time of the decision [s] and starts of robots."""
    with Net().worn() as net:
        process = centre(net, clock=lambda: over.now)
        monkeypatch.setattr(process.centre, "decide", lambda t, _, start: decide(process, t, start) or [])
        process.run(over)
    return process


def test_decisions_follow_start_and_skip_standstill(monkeypatch):
    over, decided = Over(12), []

    def decide(process, t, start):
        decided.append((t / process.ticks.period, (over.now - BEGIN) / process.ticks.period))
        if len(decided) == 3:
            for row in process.guided:
                start[row] = 4.25 * process.ticks.period  # robots began there
        over.now += (3.9 if len(decided) == 8 else 0.1) * process.ticks.period

    process = decisions(monkeypatch, over, decide)
    late = 0.05  # of a period of 0.1 s: half a tick of a body at 100 Hz
    times = [0, 1, 2, 3, 3.25, 4.25, 5.25, 6.25, 9.25, 10.25, 11.25, 12.25]
    assert [t for t, _ in decided] == pytest.approx(times)
    delays = [at - t for t, at in decided]
    assert delays == pytest.approx([late if t != 9.25 else 6.25 + late + 3.9 - 9.25 for t in times])
    assert process.missed == 2
    assert process.ticks.next == pytest.approx(13.25 * process.ticks.period)


def test_long_wait_decides_for_no_past_instant(monkeypatch):
    over, ages, late = Over(12, more=0.73), [], []

    def decide(process, t, _start):
        ages.append(over.now - BEGIN - t)
        late.append(process.late_s)

    process = decisions(monkeypatch, over, decide)
    assert len(ages) == 12
    assert max(ages) < process.ticks.period + process.patience_s
    assert process.missed == int(0.73 / process.ticks.period)
    assert max(late) == pytest.approx(0.73, abs=1e-9)


@pytest.mark.parametrize("asleep", [False, True])
@pytest.mark.parametrize(("stands_s", "lost", "forgiven"), [(0.05, 0, False), (0.255, 19, False), (2.0, 194, True)])
def test_lateness_is_caught_up_and_standstill_lost(stands_s, lost, forgiven, asleep, monkeypatch):
    now, simulated, slept = [BEGIN], [], []
    over = threading.Event()
    lost += asleep and lost > 0  # it begins when a tick is due, not after one

    def sleep(seconds):
        now[0] += seconds + (stands_s if asleep and len(simulated) == 20 else 0.0)

    bodies = WorldBodies(world_plan())
    advance = bodies.advance

    def stand():
        advance()
        simulated.append(bodies.time)
        now[0] += stands_s if len(simulated) == 20 and not asleep else 0.001
        if len(simulated) == 150:
            over.set()

    monkeypatch.setattr(world_module, "time", types.SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(bodies, "advance", stand)
    with Net().worn() as net:
        process = joined_world(net, bodies, clock=lambda: now[0])
        monkeypatch.setattr(process.commands, "forgive", lambda seconds, t: slept.append((seconds, t)))
        process.run(over)
    assert bodies.time == pytest.approx(150 / WORLD_HZ), "each tick simulates its period"
    assert now[0] - BEGIN == pytest.approx((149 + lost) / WORLD_HZ + 0.001), "in time again"
    assert slept == ([(pytest.approx(lost / WORLD_HZ), pytest.approx((20 + lost) / WORLD_HZ))] if lost else [])
    assert any(seconds > world_network.HANG_S for seconds, _ in slept) == forgiven
