"""Pace of the world on a simulated clock: a little lateness is caught up, the time of a standstill is lost."""

import threading
import types

import pytest

from agents.network.keys import Keys
from agents.network.name_ownership import OwnershipCheck
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.real_time.processes import world, world_network
from experiments.real_time.processes.joining import Network
from experiments.real_time.processes.world import WorldProcess
from experiments.real_time.processes.world_population import WorldBodies
from tests.agents.few import pair
from tests.fuzz.loopnet import Net

HZ, KEYS = 100.0, Keys("park")


@pytest.mark.parametrize("asleep", [False, True])
@pytest.mark.parametrize(("stands_s", "lost", "forgiven"), [(0.05, 0, False), (0.255, 19, False), (2.0, 194, True)])
def test_lateness_is_caught_up_and_standstill_lost(stands_s, lost, forgiven, asleep, monkeypatch):
    now, simulated, slept = [1000.0], [], []
    over = threading.Event()
    lost += asleep and lost > 0  # it begins when a tick is due, not after one

    def sleep(seconds):
        now[0] += seconds + (stands_s if asleep and len(simulated) == 20 else 0.0)

    monkeypatch.setattr(world, "time", types.SimpleNamespace(sleep=sleep))
    drone = RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5, body="world")
    experiment = pair(robots={"F": drone}, formation=Formation())
    with Net().worn() as net:
        population = WorldBodies(Plan(experiment))
        joint = Network(net.session, KEYS, [], [], OwnershipCheck([KEYS.world_alive]))
        process = WorldProcess(Plan(experiment), population, joint, threading.Event(), lambda: now[0])
        monkeypatch.setattr(process.exchange.commands, "forgive", lambda seconds, t: slept.append((seconds, t)))
        advance = population.advance

        def stand():
            advance()
            simulated.append(population.time)
            now[0] += stands_s if len(simulated) == 20 and not asleep else 0.001
            if len(simulated) == 150:
                over.set()

        monkeypatch.setattr(population, "advance", stand)
        process.run(over)
    assert population.time == pytest.approx(150 / HZ), "each tick simulates its period"
    assert now[0] - 1000.0 == pytest.approx((149 + lost) / HZ + 0.001), "in time again"
    assert slept == ([(pytest.approx(lost / HZ), pytest.approx((20 + lost) / HZ))] if lost else [])
    assert any(seconds > world_network.HANG_S for seconds, _ in slept) == forgiven
