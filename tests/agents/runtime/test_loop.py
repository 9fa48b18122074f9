"""The loop of a robot process on a simulated clock: skipped ticks, and a hold after it stood still."""

import types

import pytest

from agents.body.fleet import assemble
from agents.network.keys import Keys
from agents.runtime import loop
from agents.runtime.loop import Runtime, Setup
from experiments.definition import bodies
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.fuzz.loopnet import Net

HZ = 100.0


@pytest.mark.parametrize(
    ("stands_s", "missed", "holds"), [(0.005, 0, False), (0.075, 6, False), (0.605, 59, True), (8.005, 799, True)]
)
def test_a_loop_that_stood_still_skips_ticks_and_holds_after_a_suspension(stands_s, missed, holds, monkeypatch, capsys):
    now, times = [1000.0], []

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr(loop, "time", types.SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(loop, "uptime", lambda: now[0])  # it alone goes on while the machine sleeps
    experiment = pair()
    with Net().worn() as net:
        body = assemble(bodies.body_request(experiment, ("A",), [1]))
        runtime = Runtime(
            Plan(experiment).assignment(("A",)),
            body,
            Setup(Keys("park"), [], "json", 50.0, lifeline=False, located=[False]),
        )
        body.open()
        runtime._join(net.session)
        tick = runtime._tick

        def worked(t):
            times.append(t)
            tick(t)
            now[0] += stands_s if len(times) == 5 else 0.001

        monkeypatch.setattr(runtime, "_tick", worked)

        def stopping():
            if len(times) < 12:
                return None
            runtime.agent.lifecycle.phase[:] = loop.Phase.DONE
            return "enough"

        runtime._run_ticks(stopping)
    assert times == pytest.approx([(k if k < 5 else k + missed) / HZ for k in range(12)])
    assert runtime._counts.missed == missed
    assert runtime.agent.tick == 12 + missed
    assert (f"stood still for {stands_s:.1f} s; holding" in capsys.readouterr().out) == holds
    assert (runtime.agent.health.resumed_at == pytest.approx((5 + missed) / HZ)) == holds
