"""Triggers, prediction and updates of an experiment file: how they are chosen, refused, recorded and counted."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from agents.plugins.predictors import HOLD, ConstantVelocity
from experiments.definition.experiment import ChannelTable, Formation
from experiments.definition.plan import Plan
from experiments.file import consistency, document
from experiments.metrics import measure, signals
from experiments.virtual_time import simulation
from experiments.virtual_time.log import RunRecorder
from tests.agents.swarm import changed

pytestmark = pytest.mark.slow  # runs and reports, whole

CHOSEN = {"kind": "predictive", "threshold": 0.011, "smoothing_s": 0.4}


@pytest.fixture(scope="module")
def park():
    return document.read("robotic-park").cases()["periodic"].experiment


def measured(experiment, seeds):
    logs = (simulation.simulate(Plan(experiment), seed) for seed in seeds)
    return [measure.measure(RunRecorder(log, Plan(experiment), "").trace()) for log in logs]


def mean(cases, index):
    return np.mean([case.mean[index] for case in cases])


# ---------------------------------------------------------------- what is chosen


def test_prediction_defaults_to_what_the_trigger_needs(park):
    assert Plan(park).predictor is HOLD
    assert Plan(changed(park, trigger="predictive")).predictor == ConstantVelocity()
    assert Plan(changed(park, trigger=CHOSEN)).predictor == ConstantVelocity()
    said = {"kind": "constant-velocity", "horizon_s": 0.5}
    assert Plan(changed(park, trigger=CHOSEN, prediction=said)).predictor == ConstantVelocity(horizon_s=0.5)
    assert Plan(changed(park, prediction="constant-velocity")).predictor == ConstantVelocity()
    assert Plan(changed(park, prediction="hold")).predictor is HOLD


def updating(park, update):
    return changed(park, formation=msgspec.structs.replace(park.formation, update=update))


@pytest.mark.parametrize(
    ("change", "path", "message", "hint"),
    [
        ({"trigger": "relative-control"}, ("trigger",), "when the law is recomputed", "update = 'relative-control'"),
        ({"trigger": CHOSEN, "prediction": "hold"}, ("prediction",), "neighbours that extrapolate", "leave prediction"),
        ({"update": "predictive"}, ("formation", "update"), "when a robot transmits", "relative-control"),
        (
            {"update": {"kind": "mixed", "smoothing_s": 0.1}},
            ("formation", "update", "smoothing_s"),
            "for transmissions",
            "leave it out",
        ),
    ],
)
def test_triggers_where_they_make_no_sense_are_refused(park, change, path, message, hint):
    rest = {key: value for key, value in change.items() if key != "update"}
    wrong = changed(updating(park, change.get("update")), **rest)
    (fault,) = consistency.faults(Plan(wrong))
    assert fault.path == path
    assert message in fault.message
    assert hint in fault.hint


@pytest.mark.parametrize(
    "change",
    [
        {"trigger": CHOSEN},
        {"trigger": CHOSEN, "prediction": {"kind": "constant-velocity", "horizon_s": 1.0}},
        {"trigger": "send-on-delta", "prediction": "hold"},
        {"update": "relative-control"},
        {"update": {"kind": "send-on-delta", "threshold": 0.02}},
    ],
)
def test_triggers_where_they_make_sense_are_not(park, change):
    rest = {key: value for key, value in change.items() if key != "update"}
    assert not list(consistency.faults(Plan(changed(updating(park, change.get("update")), **rest))))


# ---------------------------------------------------------------- what is sent, believed and counted


@pytest.fixture(scope="module")
def flown(park):
    """A short run with the chosen trigger on a network with a delay, as a log and as a trace."""
    experiment = changed(park, trigger=CHOSEN, duration_s=8.0, timeline=[], channel=ChannelTable(delay_s=0.05))
    log = simulation.simulate(Plan(experiment), 4)
    return log, RunRecorder(log, Plan(experiment), "predictive").trace()


def test_received_poses_equal_sent_ones_with_velocity(flown):
    _, trace = flown
    sent = {
        (robot, seq): (*place, *moves)
        for robot, seq, place, moves in zip(
            trace.sent.link.tolist(), trace.sent.seq.tolist(), trace.sent.position.tolist(),
            trace.sent.velocity.tolist(), strict=True,
        )
    }  # fmt: skip
    heard = trace.received
    speaker = trace.plan.pose_links.sender[heard.link]
    known = [k for k in range(len(heard.seq)) if (speaker[k], heard.seq[k]) in sent]
    assert len(known) > 30
    for k in known:
        assert sent[speaker[k], heard.seq[k]] == (*heard.position[k].tolist(), *heard.velocity[k].tolist())
    assert np.abs(trace.received.velocity).max() > 0.05


def test_what_is_said_is_smoothed(flown):
    log, trace = flown
    drone = trace.robots.index("CF02")
    mine = trace.sent_by(drone)
    at = np.searchsorted(trace.time, mine.stamp - 1e-9)
    off = mine.position - trace.position[at, drone]
    assert 0.002 < np.sqrt((off[:, :2] ** 2).mean()) < 0.03
    assert log.sent.position.shape == log.sent.velocity.shape


def test_belief_error_is_that_of_the_prediction(flown):
    _, trace = flown
    net = trace.plan.links
    found = signals.belief_errors(trace, net)
    listener, speaker, heard, ends = net.receiver, net.sender, trace.received, trace.plan.pose_links
    for link in np.flatnonzero(speaker > 0)[::5]:  # the leader stands, and says nothing after the start
        asked = (ends.receiver == listener[link]) & (ends.sender == speaker[link])
        mine = np.flatnonzero(asked[heard.link])
        for k in (150, 300, 399):
            last = mine[heard.arrival[mine] <= trace.time[k]][-1]
            ahead = heard.position[last] + heard.velocity[last] * (trace.time[k] - heard.stamp[last])
            wanted = math.dist(ahead, trace.true_position[k, speaker[link]])
            assert found[k, link] == pytest.approx(wanted, abs=1e-12)
    held = dataclasses.replace(trace, plan=trace.plan.changed(trigger="send-on-delta"))
    assert np.nanmean(signals.belief_errors(held, net) ** 2) > 4.0 * np.nanmean(found**2)


def test_updates_are_counted_for_each_robot(park):
    experiment = changed(updating(park, {"kind": "send-on-delta", "threshold": 0.02}), duration_s=12.0, timeline=[])
    log = simulation.simulate(Plan(experiment), 1)
    assert log.updates[0] == log.decisions == 120
    trace = RunRecorder(log, Plan(experiment), "").trace()
    np.testing.assert_array_equal(trace.decisions, log.updates)
    assert (trace.decisions[1:] < 120).all()
    assert (trace.decisions[1:] > 10).all()
    assert [robot.updates for robot in measure.measure(trace).robots] == trace.decisions.tolist()


# ---------------------------------------------------------------- what it is good for

SEEDS = (1, 2)  # parameters were chosen on 1001 to 1010


@pytest.fixture(scope="module")
def whole(park):
    """Runs that transmit periodically."""
    return measured(park, SEEDS)


@pytest.mark.slow
def test_smoothed_prediction_saves_97_percent_and_costs_little(park, whole):
    periodic, predictive = whole, measured(changed(park, trigger=CHOSEN), SEEDS)
    assert mean(predictive, "f_hz") <= 0.03 * mean(periodic, "f_hz")
    assert mean(predictive, "iae") <= 1.02 * mean(periodic, "iae")
    assert mean(predictive, "itae") <= 1.05 * mean(periodic, "itae")
    assert all(None not in case.acquired_s for case in predictive)


@pytest.mark.slow
def test_maximum_silence_stops_runaway_prediction_on_bad_network(park, whole):
    bad = changed(park, trigger={**CHOSEN, "maximum_silence_s": 2.0}, channel=ChannelTable(delay_s=0.05, loss=0.1))
    cases = measured(bad, SEEDS)
    assert all(None not in case.acquired_s for case in cases)
    assert mean(cases, "iae") < 1.03 * mean(whole, "iae")


def test_formation_without_links_has_no_law_to_gate(park):
    alone = changed(
        park,
        robots={"KH01": park.robots["KH01"]},
        formation=Formation(update="send-on-delta"),
        timeline=[],
        duration_s=2.0,
    )
    assert simulation.simulate(Plan(alone), 1).updates.tolist() == [20]
