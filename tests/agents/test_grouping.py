"""However robots are grouped in processes and bodies, they do the same to the last bit."""

import pytest

from agents.decision.lifecycle import DONE
from experiments.definition.experiment import LegTable
from tests.agents.swarm import LOGGED, Swarm
from tests.small import NOISY, changed, reference

ALONE = [[name] for name in reference().robots]
THREE = [["CF03", "TB01", "KH02"], ["KH01", "CF01"], ["CF02", "KH03"]]
WAYS = {
    "mixed": ({"kind": "mixed", "evaluate_every_s": 0.06}, None, {"kind": "mixed", "maximum_silence_s": 0.5}),
    "dynamic": ({"kind": "dynamic", "smoothing_s": 0.2}, "constant-velocity", "dynamic"),
    "predictive": ({"kind": "predictive", "smoothing_s": 0.4}, None, "relative-control"),
    "self-triggered": ("self-triggered", {"kind": "constant-velocity", "horizon_s": 0.3}, "lyapunov"),
}


def eventful(experiment, groups):
    """A short run with everything that may happen; the same whoever shares a process with whom."""
    swarm = Swarm(experiment, groups).running().run(1.5)
    receivers = [name for name in swarm.names if "CF03" in [each.name for each in swarm.robot(name).neighbours.all]]
    for name in receivers:  # its token is gone, then back
        swarm.robot(name).neighbours.mark_lost(swarm.link(name, "CF03"), swarm.t)
    assert swarm.robot("KH02").hold() == ""
    swarm.run(1.53)
    for name in receivers:
        swarm.find("CF03", name)
    assert swarm.robot("KH02").start(0.0) == ""
    swarm.run(0.5).robot("CF02").lifecycle.land("told to")
    return swarm.run(0.5).until(DONE)


@pytest.mark.slow
@pytest.mark.parametrize("way", [None, *WAYS])
def test_robots_apart_equal_robots_together(way):
    park = reference()
    if way is not None:
        trigger, prediction, update = WAYS[way]
        park = changed(park, trigger=trigger, prediction=prediction, formation=changed(park.formation, update=update))
    legs = [LegTable(at_s=2.0, robot="TB01", plan={"kind": "line", "move_by": [0.3, 0.1], "speed": 0.15})]
    experiment = changed(park, duration_s=5.0, timeline=legs, disturbance=NOISY)
    together = eventful(experiment, [tuple(experiment.robots)])
    for groups in [THREE] if way else [ALONE, THREE]:
        apart = eventful(experiment, groups)
        assert (apart.sent, apart.start_at) == (together.sent, together.start_at)
        for name in experiment.robots:
            for what in LOGGED:  # texts: NaN equals NaN
                assert repr(apart.column(name, what)) == repr(together.column(name, what)), (name, what)
            assert apart.robot(name).updates == together.robot(name).updates
    assert len(together.sent) > (50 if way else 300)
    assert {together.phase(name) for name in together.names} == {DONE}
    decisions, updates = together.robot("KH01").decisions, [together.robot(name).updates for name in together.names]
    assert decisions > 40
    assert updates[0] == decisions  # a leader has no law to compute
    assert min(updates) > 1
    assert way is None or sum(updates) < 0.98 * max(updates) * len(updates), updates
