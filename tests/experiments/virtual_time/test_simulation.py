"""The virtual clock: the same bits from the same seed, alone or beside other seeds, and names when it gets stuck."""

from dataclasses import fields

import msgspec
import numpy as np
import pytest

from agents.body.interface import Disturbance
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING
from experiments.arrays import PoseTable
from experiments.definition.experiment import ChannelTable, Experiment, Formation, LegTable, RobotTable, Start
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.virtual_time.conductor import LEAD_S, Stuck
from experiments.virtual_time.simulation import VirtualRunLog, simulate


def changed(experiment, **parts):
    return msgspec.structs.replace(experiment, **parts)


@pytest.fixture(scope="module")
def park():
    """The reference experiment with everything that is random, cut short."""
    experiment = document.read("robotic-park").cases()["event"].experiment
    nature = {
        **experiment.disturbance,
        "KH02": Disturbance(odometry_drift=0.002, latency_s=0.02),
        "CF02": Disturbance(latency_s=0.03),
    }
    leg = LegTable(at_s=2.0, robot="TB01", plan={"kind": "line", "move_by": [0.2, 0.0], "speed": 0.2})
    trigger = {"kind": "send-on-delta", "threshold": 0.01, "maximum_silence_s": 0.2}
    channel = ChannelTable(delay_s=0.004, jitter_s=0.01, loss=0.2)
    return changed(experiment, duration_s=4.0, disturbance=nature, timeline=[leg], trigger=trigger, channel=channel)


def ground(**parts):
    """Two ground robots that listen to each other."""
    robots = {"A": RobotTable(kind="khepera4", start=[-0.4, 0.0]), "B": RobotTable(kind="khepera4", start=[0.4, 0.1])}
    given = {"title": "A pair", "duration_s": 2.0, "robots": robots, "formation": Formation(links={"A - B": 0.5})}
    return Experiment(**{**given, **parts})


def same(a: VirtualRunLog, b: VirtualRunLog):
    """To the last bit, NaN included."""
    for field in fields(VirtualRunLog):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, PoseTable):
            one, other = msgspec.structs.astuple(one)[:6], msgspec.structs.astuple(other)[:6]
        for x, y in zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]:
            np.testing.assert_array_equal(np.asarray(x), np.asarray(y), err_msg=field.name)


@pytest.mark.slow
def test_same_seed_gives_same_bits_and_another_others(park):
    first = simulate(Plan(park), 7)
    same(first, simulate(Plan(park), 7))
    other = simulate(Plan(park), 8)
    assert not np.array_equal(first.position[-1], other.position[-1])


def test_the_common_start_is_time_zero():
    log = simulate(Plan(ground()), 1)
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


def test_phases_never_go_back(park):
    log = simulate(Plan(park), 1)
    assert (np.diff(log.phase, axis=0) >= 0).all()
    assert {IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE} >= set(log.phase.ravel().tolist())
    assert (log.true_position[-1, 4:, 2] < 0.03).all()  # down, or about to touch down
    assert (log.true_position[..., 2] >= 0.0).all()


def test_periodic_poses_are_all_sent_and_all_heard():
    log = simulate(Plan(ground(trigger={"kind": "periodic", "period_s": 0.1})), 1)
    time, row, seq, position = log.sent.stamp, log.sent.link, log.sent.seq, log.sent.position
    run = (time >= -1e-9) & (time < 2.0 - 1e-9)
    assert np.bincount(row[run]).tolist() == [20, 20]
    for robot in range(2):
        np.testing.assert_array_equal(seq[row == robot], np.arange(1, (row == robot).sum() + 1))
    got = log.received
    arrival, link, number, stamp, place = got.arrival, got.link, got.seq, got.stamp, got.position
    np.testing.assert_allclose(arrival - stamp, 0.001, atol=1e-9)
    for this, (listener, speaker) in enumerate([(0, 1), (1, 0)]):
        assert listener != speaker
        mine, theirs = link == this, row == speaker
        count = mine.sum()
        np.testing.assert_array_equal(number[mine], seq[theirs][:count])
        np.testing.assert_array_equal(place[mine], position[theirs][:count])
        assert count >= theirs.sum() - 1
    assert not log.lost.any()


def test_losses_are_counted_from_start_to_landing():
    experiment = ground(channel=ChannelTable(loss=0.25), duration_s=10.0)
    log = simulate(Plan(experiment), 1)
    time, row = log.sent.stamp, log.sent.link
    run = (time >= -1e-9) & (time < 10.0 - 1e-9)
    heard = log.received
    stamped = (heard.stamp >= -1e-9) & (heard.stamp < 10.0 - 1e-9)
    for link, speaker in enumerate((1, 0)):
        missing = (row[run] == speaker).sum() - (heard.link[stamped] == link).sum()
        assert log.lost[link] == missing
    assert log.lost.sum() / run.sum() == pytest.approx(0.25, abs=0.05)


def test_one_robot_alone():
    robots = {"F": RobotTable(kind="crazyflie", start=[0.2, -0.1], hover=0.6)}
    plan = {"kind": "circle", "radius": 0.2, "period_s": 8.0}
    leg = LegTable(at_s=0.0, robot="F", plan=plan)
    log = simulate(Plan(Experiment(title="Alone", duration_s=8.0, robots=robots, timeline=[leg])), 1)
    run = (log.time >= 0.0) & (log.time <= 8.0)
    path = log.true_position[run, 0]
    assert len(log.received) == 0
    assert np.abs(path[:, 2] - 0.6).max() < 0.05
    centre = np.array([0.2, 0.1])
    # a position controller lags behind a circle and cuts it
    assert np.linalg.norm(path[100:, :2] - centre, axis=1).max() < 0.21
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
    nature = {"all": Disturbance(position_sigma=0.0003)}
    experiment = Experiment(
        title="Triangle", duration_s=25.0, robots=robots, formation=Formation(links=links), disturbance=nature
    )
    log = simulate(Plan(experiment), 1)
    a, b, f = log.true_position[np.flatnonzero(log.time <= 25.0)[-1]]
    for one, other, distance in ((a, b, 0.6), (a, f, 0.8), (b, f, 0.8)):
        assert np.linalg.norm(one - other) == pytest.approx(distance, abs=0.012)
    assert not log.interventions.any()


def test_the_reference_formation_is_acquired():
    experiment = changed(document.read("robotic-park").cases()["event"].experiment, duration_s=18.0, timeline=[])
    log = simulate(Plan(experiment), 1)
    last = log.error[np.flatnonzero(log.time <= 18.0)[-1]]
    links_each = np.array([0, 4, 3, 4, 4, 4, 2])
    assert (last <= 0.03 * links_each + 1e-9).all()
    inside = np.abs(log.true_position[..., :2]).max()
    assert inside < 1.0
    sent = np.bincount(log.sent.link[(log.sent.stamp >= 0) & (log.sent.stamp < 18)], minlength=7) / 18.0
    assert sent[0] < 0.5  # the leader stands
    assert sent.max() < 20.0
    assert sent[4:].mean() > sent[1:4].mean() > 3.0


def test_who_hears_nobody_is_named():
    with pytest.raises(Stuck, match=r"not ready after 5 s: A, B \(never received B\)"):
        simulate(Plan(ground(channel=ChannelTable(delay_s=100.0))), 1, patience_s=5.0)


def test_who_cannot_get_up_is_named(monkeypatch):
    monkeypatch.setattr("agents.decision.lifecycle.AT_HEIGHT", -1.0)  # nobody is ever near enough to his height
    robots = {
        "A": RobotTable(kind="khepera4", start=[0.0, 0.0]),
        "F": RobotTable(kind="crazyflie", start=[0.5, 0.0], hover=0.5),
        "G": RobotTable(kind="crazyflie", start=[-0.5, 0.0], hover=0.5),
    }
    with pytest.raises(Stuck, match=r"not airborne after 5 s: F, G"):
        simulate(Plan(Experiment(title="Stuck", duration_s=1.0, robots=robots)), 1, patience_s=5.0)


def test_robot_goes_on_without_a_never_received_neighbour():
    log = simulate(Plan(ground(channel=ChannelTable(delay_s=100.0), start=Start(deadline_s=1.0, missing="go-on"))), 1)
    run = (log.time >= 0.0) & (log.time <= 2.0)
    np.testing.assert_allclose(log.true_position[run], np.tile(log.true_position[0], (run.sum(), 1, 1)), atol=1e-9)
    assert not log.error.any()
    assert log.time[0] == pytest.approx(-1.5 - 0.5 - LEAD_S)  # ready after 1 s, sent off at 1.5 s, up, started at 2 s


def test_all_is_lost_inside_run_and_nothing_outside():
    log = simulate(Plan(ground(channel=ChannelTable(loss=1.0))), 1)
    stamp = log.received.stamp
    assert not ((stamp > -1e-9) & (stamp < 2.0 - 1e-9)).any()
    assert stamp.max() >= 2.0 - 1e-9
    assert len(log.received) > 50
    assert log.lost.tolist() == [100, 100]
