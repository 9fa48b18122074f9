"""However robots are grouped in processes and bodies, they do the same to the last bit."""

import pytest

from agents.decision.lifecycle import DONE
from experiments.definition.experiment import LegTable
from tests.agents.swarm import LOGGED, Swarm
from tests.small import NOISY, changed, reference


def eventful(experiment, groups):
    """A short run with everything that may happen; the same whoever shares a process with whom."""
    swarm = Swarm(experiment, groups).running().run(1.5)
    receivers = swarm.receivers("CF03")
    for name in receivers:  # its token is gone, then back
        swarm.robot(name).neighbours.mark_lost(swarm.link(name, "CF03"), swarm.t)
    assert swarm.robot("KH02").hold() == ""
    swarm.run(1.53)
    swarm.find("CF03")
    assert swarm.robot("KH02").start(0.0) == ""
    swarm.run(0.5)
    swarm.robot("CF02").lifecycle.land("told to")
    return swarm.run(0.5).until(DONE)


@pytest.mark.slow
def test_processes_of_one_equal_one_of_seven():
    groups = [["CF03", "TB01", "KH02"], ["KH01", "CF01"], ["CF02", "KH03"]]
    assert_the_same(reference(), [[name] for name in reference().robots], groups)


WAYS = {
    "periodic": ("periodic", None, {"kind": "periodic", "period_s": 0.3}),
    "send-on-delta": ({"kind": "send-on-delta", "smoothing_s": 0.3}, None, "send-on-delta"),
    "relative": ({"kind": "relative", "minimum_interval_s": 0.06}, "constant-velocity", "relative"),
    "mixed": ({"kind": "mixed", "evaluate_every_s": 0.06}, None, {"kind": "mixed", "maximum_silence_s": 0.5}),
    "decaying": ("decaying", {"kind": "constant-velocity", "horizon_s": 0.5}, "decaying"),
    "dynamic": ({"kind": "dynamic", "smoothing_s": 0.2}, "constant-velocity", "dynamic"),
    "integral": ({"kind": "integral", "evaluate_every_s": 0.1, "smoothing_s": 0.2}, None, "integral"),
    "predictive": ({"kind": "predictive", "smoothing_s": 0.4}, None, "relative-control"),
    "self-triggered": ("self-triggered", None, "self-triggered"),
    "self-triggered ahead": ("self-triggered", {"kind": "constant-velocity", "horizon_s": 0.3}, "lyapunov"),
    "lyapunov": ({"kind": "lyapunov", "maximum_silence_s": 0.7}, "constant-velocity", None),
}
BY_DAY = ("mixed", "dynamic", "predictive", "self-triggered ahead")


@pytest.mark.slow
@pytest.mark.parametrize(
    "way", [way if way in BY_DAY else pytest.param(way, marks=pytest.mark.nightly) for way in WAYS]
)
def test_every_trigger_predictor_and_smoothing(way):
    park, (trigger, prediction, update) = reference(), WAYS[way]
    formation = changed(park.formation, update=update)
    experiment = changed(park, trigger=trigger, prediction=prediction, formation=formation)
    groups = [["TB01"], ["CF03", "KH02"], ["KH01", "CF01"], ["CF02"], ["KH03"]]
    together = assert_the_same(experiment, groups, least=50)
    decisions, updates = together.robot("KH01").decisions, [together.robot(name).updates for name in together.names]
    assert decisions > 40
    assert updates[0] == decisions  # a leader has no law to compute
    assert min(updates) > 1
    assert update is None or sum(updates) < 0.98 * max(updates) * len(updates), updates


def assert_the_same(park, *grouped, least=300):
    """However they are grouped; gives the run of all in one process."""
    line = {"kind": "line", "move_by": [0.3, 0.1], "speed": 0.15}
    experiment = changed(
        park, duration_s=5.0, timeline=[LegTable(at_s=2.0, robot="TB01", plan=line)], disturbance=NOISY
    )
    together = eventful(experiment, [tuple(experiment.robots)])
    for groups in grouped:
        apart = eventful(experiment, groups)
        assert apart.sent == together.sent
        assert apart.start_at == together.start_at
        for name in experiment.robots:
            for what in LOGGED:  # texts: NaN equals NaN
                assert repr(apart.column(name, what)) == repr(together.column(name, what)), (name, what)
            assert apart.robot(name).updates == together.robot(name).updates
    assert len(together.sent) > least
    assert {together.phase(name) for name in together.names} == {DONE}
    return together
