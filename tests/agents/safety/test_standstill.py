"""A process that stood still holds until its neighbours were heard again."""

import numpy as np
import pytest

from agents.body.limits import Safety
from agents.safety.situation import SILENT_S
from experiments.definition.experiment import Formation
from tests.agents.few import pair
from tests.agents.safety.test_detection import happened
from tests.agents.swarm import Swarm


def held(swarm, seconds):
    """Ticks of so long on which A is held."""
    count = 0
    for _ in range(round(seconds / swarm.dt)):
        swarm.step()
        count += bool(swarm.agent("A").hazards.held[0])
    return count


def woken(slept=0.6, **parts):
    """A and B run in processes of their own; that of A has just stood still."""
    swarm = Swarm(pair(**parts), [["A"], ["B"]]).running()
    swarm.run(3.0)
    swarm.agent("A").health.mark_resumed(swarm.t, slept)
    return swarm


def test_a_process_that_stood_still_holds_until_it_has_heard_its_neighbours_again():
    swarm = woken()
    assert 1 <= held(swarm, 3.0) <= 4  # B speaks 50 times a second
    told = [text.split(", after")[0] for text in happened(swarm)["A"]]
    assert told == [
        "hold: its process stood still: for 0.6 s; it waits for its neighbours",
        "over: its process stood still",
    ]


@pytest.mark.parametrize("slept", [0.6, 1.5, 2.2])
def test_who_is_silent_after_a_standstill_has_nothing_new_to_say(slept):
    swarm = woken(slept, trigger={"kind": "send-on-delta", "threshold": 1.0})
    assert held(swarm, 3.0) == pytest.approx(SILENT_S / swarm.dt, abs=1)


def test_who_is_gone_is_not_waited_for_after_a_standstill():
    swarm = woken(trigger={"kind": "send-on-delta", "threshold": 1.0}, safety=Safety(lost_neighbour="drop"))
    swarm.agent("A").neighbours.mark_lost(np.array([0]), swarm.t)
    assert held(swarm, 0.5) == 0


def test_after_a_standstill_neighbours_are_waited_for_from_when_the_router_is_back():
    swarm = woken(trigger={"kind": "send-on-delta", "threshold": 1.0})
    outside = swarm.agent("A").health
    outside.offline_since = swarm.t
    assert held(swarm, 3.0) == round(3.0 / swarm.dt)
    outside.offline_since = np.inf
    assert held(swarm, 3.0) == pytest.approx(SILENT_S / swarm.dt, abs=1)
    outside.offline_since = swarm.t  # much later: that standstill is over
    assert held(swarm, 0.5) == 0


def test_who_hears_nobody_does_not_hold_after_a_standstill():
    swarm = Swarm(pair(formation=Formation()), [["A"], ["B"]]).running()
    swarm.agent("A").health.mark_resumed(swarm.t, 0.6)
    assert held(swarm, 0.5) == 0
