"""The virtual clock: the same bits from the same seed, alone or beside other seeds, and names when it gets stuck."""

from dataclasses import fields

import numpy as np
import pytest

from agents.body.interface import Disturbance
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING
from experiments.definition.experiment import ChannelTable, LegTable, RobotTable, Start
from experiments.definition.plan import Plan
from experiments.virtual_time.conductor import LEAD_S, Stuck
from experiments.virtual_time.simulation import VirtualRunLog, simulate
from tests.experiments.virtual_time.evaluators import alike
from tests.runs import fly
from tests.small import changed, pair, reference, small


@pytest.fixture(scope="module")
def random_park():
    """The reference experiment with everything that is random, cut short."""
    nature = reference().disturbance | {
        "KH02": Disturbance(odometry_drift=0.002, latency_s=0.02),
        "CF02": Disturbance(latency_s=0.03),
    }
    leg = LegTable(at_s=2.0, robot="TB01", plan={"kind": "line", "move_by": [0.2, 0.0], "speed": 0.2})
    trigger = {"kind": "send-on-delta", "threshold": 0.01, "maximum_silence_s": 0.2}
    channel = ChannelTable(delay_s=0.004, jitter_s=0.01, loss=0.2)
    return changed(reference(), duration_s=4.0, disturbance=nature, timeline=[leg], trigger=trigger, channel=channel)


def ground(**parts):
    """Log of two ground robots that listen to each other."""
    return fly(pair(**{"duration_s": 2.0, "trigger": "periodic", **parts})).log


def assert_same(first, second):
    """To the last bit, NaN included."""
    for field in fields(VirtualRunLog):
        assert alike(getattr(first, field.name), getattr(second, field.name)), field.name


@pytest.mark.slow
def test_same_seed_gives_same_bits_and_another_others(random_park):
    first, again, other = (simulate(Plan(random_park), seed) for seed in (7, 7, 8))
    assert_same(first, again)
    assert not np.array_equal(first.position[-1], other.position[-1])


def test_the_common_start_is_time_zero():
    log = ground()
    k = int(np.argmin(np.abs(log.time)))
    assert log.time[k] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(np.diff(log.time), 0.02, atol=1e-9)  # state_hz
    assert log.phase[k].tolist() == [RUNNING, RUNNING]
    assert log.phase[k - 1].tolist() == [AIRBORNE, AIRBORNE]
    assert log.phase[0].tolist() == [IDLE, IDLE]
    assert log.airborne == pytest.approx(-LEAD_S)
    end = int(np.flatnonzero(log.time < 2.0 - 1e-9)[-1])
    assert log.phase[end].tolist() == [RUNNING, RUNNING]
    assert (log.phase[end + 1] >= LANDING).all()
    assert log.ended - log.time[-1] <= 0.02 + 1e-9
    assert (log.decisions, log.ticks) == (20, 200)


def test_phases_never_go_back(random_park):
    log = fly(random_park).log
    assert (np.diff(log.phase, axis=0) >= 0).all()
    assert {IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE} >= set(log.phase.ravel().tolist())
    assert (log.true_position[-1, 4:, 2] < 0.03).all()  # down, or about to touch down
    assert (log.true_position[..., 2] >= 0.0).all()


def test_periodic_poses_are_all_sent_and_all_heard():
    log = ground(trigger={"kind": "periodic", "period_s": 0.1})
    sent, got = log.sent, log.received
    run = (sent.stamp >= -1e-9) & (sent.stamp < 2.0 - 1e-9)
    assert np.bincount(sent.link[run]).tolist() == [20, 20]
    np.testing.assert_allclose(got.arrival - got.stamp, 0.001, atol=1e-9)
    for link, speaker in ((0, 1), (1, 0)):
        theirs, mine = sent.take(sent.link == speaker), got.take(got.link == link)
        count = len(mine)
        assert theirs.seq.tolist() == [*range(1, len(theirs) + 1)]
        np.testing.assert_array_equal(mine.seq, theirs.seq[:count])
        np.testing.assert_array_equal(mine.position, theirs.position[:count])
        assert count >= len(theirs) - 1
    assert not log.lost.any()


def test_losses_are_counted_from_start_to_landing():
    log = ground(channel=ChannelTable(loss=0.25), duration_s=10.0)
    sent, heard = (each.take((each.stamp >= -1e-9) & (each.stamp < 10.0 - 1e-9)) for each in (log.sent, log.received))
    for link, speaker in enumerate((1, 0)):
        assert log.lost[link] == (sent.link == speaker).sum() - (heard.link == link).sum()
    assert log.lost.sum() / len(sent) == pytest.approx(0.25, abs=0.05)


def test_one_robot_alone():
    robot = RobotTable(kind="crazyflie", start=[0.2, -0.1], hover=0.6)
    leg = LegTable(at_s=0.0, robot="F", plan={"kind": "circle", "radius": 0.2, "period_s": 8.0})
    log = fly(small({"F": robot}, duration_s=8.0, timeline=[leg])).log
    path = log.true_position[(log.time >= 0.0) & (log.time <= 8.0), 0]
    assert len(log.received) == 0
    assert np.abs(path[:, 2] - 0.6).max() < 0.05
    # a position controller lags behind a circle and cuts it
    assert np.linalg.norm(path[100:, :2] - [0.2, 0.1], axis=1).max() < 0.21
    assert np.ptp(path[:, 0]) > 0.3
    np.testing.assert_allclose(path[-1, :2], [0.2, -0.1], atol=0.1)


@pytest.mark.slow
def test_three_robots_find_their_triangle():
    robots = {
        "A": RobotTable(kind="khepera4", start=[-0.6, -0.5]),
        "B": RobotTable(kind="khepera4", start=[0.6, -0.5]),
        "F": RobotTable(kind="crazyflie", start=[0.1, 0.6], hover=0.6),
    }
    links = {"A - B": 0.6, "A - F": 0.8, "B - F": 0.8}
    run = fly(small(robots, links, duration_s=25.0, disturbance={"all": Disturbance(position_sigma=0.0003)}))
    a, b, f = run.log.true_position[np.flatnonzero(run.log.time <= 25.0)[-1]]
    lengths = [np.linalg.norm(one - other) for one, other in ((a, b), (a, f), (b, f))]
    assert lengths == pytest.approx([0.6, 0.8, 0.8], abs=0.012)
    assert not run.log.interventions.any()


def test_the_reference_formation_is_acquired():
    log = fly(changed(reference(), duration_s=18.0, timeline=[])).log
    links_each = np.array([0, 4, 3, 4, 4, 4, 2])
    assert (log.error[np.flatnonzero(log.time <= 18.0)[-1]] <= 0.03 * links_each + 1e-9).all()
    assert np.abs(log.true_position[..., :2]).max() < 1.0
    sent = np.bincount(log.sent.link[(log.sent.stamp >= 0) & (log.sent.stamp < 18)], minlength=7) / 18.0
    assert sent[0] < 0.5  # the leader stands
    assert sent.max() < 20.0
    assert sent[4:].mean() > sent[1:4].mean() > 3.0


def test_who_hears_nobody_is_named():
    deaf = pair(duration_s=2.0, channel=ChannelTable(delay_s=100.0))
    with pytest.raises(Stuck, match=r"not ready after 5 s: A, B \(never received B\)"):
        simulate(Plan(deaf), 1, patience_s=5.0)


def test_who_cannot_get_up_is_named():
    stuck = small({"A": "khepera4", "F": "crazyflie", "G": "crazyflie"})
    with pytest.raises(Stuck, match=r"not airborne after 0.5 s: F, G"):
        simulate(Plan(stuck), 1, patience_s=0.5)


def test_robot_goes_on_without_a_never_received_neighbour():
    log = ground(channel=ChannelTable(delay_s=100.0), start=Start(deadline_s=1.0, missing="go-on"))
    run = (log.time >= 0.0) & (log.time <= 2.0)
    np.testing.assert_allclose(log.true_position[run], np.tile(log.true_position[0], (run.sum(), 1, 1)), atol=1e-9)
    assert not log.error.any()
    assert log.time[0] == pytest.approx(-1.5 - 0.5 - LEAD_S)  # ready after 1 s, sent off at 1.5 s, up, started at 2 s


def test_all_is_lost_inside_run_and_nothing_outside():
    log = ground(channel=ChannelTable(loss=1.0))
    stamp = log.received.stamp
    assert not ((stamp > -1e-9) & (stamp < 2.0 - 1e-9)).any()
    assert stamp.max() >= 2.0 - 1e-9
    assert len(log.received) > 50
    assert log.lost.tolist() == [100, 100]
