"""A robot is a swarm of one: however robots are grouped in processes, they do the same to the last bit."""

import msgspec
import numpy as np
import pytest

from agents.decision.lifecycle import DONE
from experiments.definition.experiment import Leg
from experiments.file import document
from tests.agents.few import NOISY
from tests.agents.swarm import Swarm, changed


@pytest.fixture(scope="module")
def park():
    return document.read("robotic-park").cases()["event"]


def eventful(experiment, groups):
    """A short run with everything that may happen; the same whoever shares a process with whom."""
    swarm = Swarm(experiment, groups).running()
    swarm.run(1.5)
    for agent, links in swarm.speaker_links("CF03"):  # its token is gone, then back
        agent.neighbours.mark_lost(links, swarm.t)
    group, row = swarm.where["KH02"]
    assert group.agent.hold(row) == ""
    swarm.run(1.53)
    for agent, links in swarm.speaker_links("CF03"):
        agent.neighbours.mark_alive(links)
    assert group.agent.start(row, 0.0) == ""
    swarm.run(0.5)
    group, row = swarm.where["CF02"]
    group.agent.lifecycle.land(row, "told to")
    swarm.run(0.5)
    swarm.until(DONE)
    return swarm


@pytest.mark.slow
def test_seven_processes_of_one_are_one_of_seven_to_the_last_bit(park):
    assert_the_same(
        park, [[name] for name in park.robots], [["CF03", "TB01", "KH02"], ["KH01", "CF01"], ["CF02", "KH03"]]
    )


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


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_so_they_are_with_every_trigger_predictor_and_smoothing(park, way):
    trigger, prediction, update = WAYS[way]
    formation = msgspec.structs.replace(park.formation, update=update)
    experiment = changed(park, trigger=trigger, prediction=prediction, formation=formation)
    groups = [["TB01"], ["CF03", "KH02"], ["KH01", "CF01"], ["CF02"], ["KH03"]]
    together = assert_the_same(experiment, groups, least=50)
    decisions = together.agent("KH01").decisions
    assert decisions > 40
    updates = np.array([group.agent.updates[row] for group, row in together.where.values()])
    assert updates[0] == decisions  # a leader has no law to compute
    assert (updates > 1).all()
    assert update is None or updates.sum() < 0.98 * updates.max() * len(updates), updates


def assert_the_same(park, *grouped, least=300):
    """However they are grouped; gives the run of all in one process."""
    line = {"kind": "line", "move_by": [0.3, 0.1], "speed": 0.15}
    experiment = changed(park, duration_s=5.0, timeline=[Leg(at_s=2.0, robot="TB01", plan=line)], disturbance=NOISY)
    together = eventful(experiment, [tuple(experiment.robots)])
    for groups in grouped:
        apart = eventful(experiment, groups)
        assert apart.sent == together.sent
        assert apart.start_at == together.start_at
        for what in ("phase", "goal", "error", "setpoint", "position", "truth"):
            np.testing.assert_array_equal(apart.column(what), together.column(what), err_msg=what)
        for name in experiment.robots:
            (one, i), (other, j) = apart.where[name], together.where[name]
            assert one.agent.updates[i] == other.agent.updates[j]
    assert len(together.sent) > least
    assert together.log[-1]["phase"].tolist() == [DONE] * 7
    return together
