"""Triggers, prediction and updates of an experiment file: how they are chosen, refused, recorded and counted."""

import dataclasses
import math

import numpy as np
import pytest

from agents.plugins.predictors import HOLD, ConstantVelocity
from experiments.definition.experiment import ChannelTable, Formation
from experiments.definition.plan import Plan
from experiments.file.consistency.whole import consistency_faults
from experiments.metrics import signals
from tests.runs import fly
from tests.small import changed, reference, small

pytestmark = pytest.mark.slow  # runs and reports, whole

CHOSEN = {"kind": "predictive", "threshold": 0.011, "smoothing_s": 0.4}


PARK = reference("periodic")
SAID = {"kind": "constant-velocity", "horizon_s": 0.5}


@pytest.mark.parametrize(
    ("parts", "predictor"),
    [
        ({}, HOLD),
        ({"trigger": "predictive"}, ConstantVelocity()),
        ({"trigger": CHOSEN}, ConstantVelocity()),
        ({"trigger": CHOSEN, "prediction": SAID}, ConstantVelocity(horizon_s=0.5)),
        ({"prediction": "constant-velocity"}, ConstantVelocity()),
        ({"prediction": "hold"}, HOLD),
    ],
)
def test_prediction_defaults_to_what_the_trigger_needs(parts, predictor):
    assert Plan(changed(PARK, **parts)).predictor == predictor


def updating(update=None, **parts):
    return changed(PARK, formation=changed(PARK.formation, update=update), **parts)


DELTA = {"kind": "send-on-delta", "threshold": 0.02}
SMOOTH = {"kind": "mixed", "smoothing_s": 0.1}


@pytest.mark.parametrize(
    ("change", "path", "message", "hint"),
    [
        ({"trigger": "relative-control"}, "trigger", "when the law is recomputed", "update = 'relative-control'"),
        ({"trigger": CHOSEN, "prediction": "hold"}, "prediction", "neighbours that extrapolate", "leave prediction"),
        ({"update": "predictive"}, "formation.update", "when a robot transmits", "relative-control"),
        ({"update": SMOOTH}, "formation.update.smoothing_s", "for transmissions", "leave it out"),
    ],
)
def test_triggers_where_they_make_no_sense_are_refused(change, path, message, hint):
    (fault,) = consistency_faults(Plan(updating(**change)))
    assert ".".join(fault.path) == path
    assert message in fault.message
    assert hint in fault.hint


@pytest.mark.parametrize(
    "change",
    [
        {"trigger": CHOSEN},
        {"trigger": CHOSEN, "prediction": SAID},
        {"trigger": "send-on-delta", "prediction": "hold"},
        {"update": "relative-control"},
        {"update": DELTA},
    ],
)
def test_triggers_where_they_make_sense_are_not(change):
    assert not list(consistency_faults(Plan(updating(**change))))


@pytest.fixture(scope="module")
def delayed_run():
    """A short run with the chosen trigger on a network with a delay."""
    parts = {"trigger": CHOSEN, "duration_s": 8.0, "timeline": [], "channel": ChannelTable(delay_s=0.05)}
    return fly(changed(PARK, **parts), 4)


def test_received_poses_equal_sent_ones_with_velocity(delayed_run):
    sent, heard = delayed_run.trace.sent, delayed_run.trace.received
    said = np.column_stack([sent.position, sent.velocity])
    by_number = dict(zip(zip(sent.link.tolist(), sent.seq.tolist(), strict=True), said.tolist(), strict=True))
    senders = delayed_run.plan.pose_links.sender[heard.link].tolist()
    got = np.column_stack([heard.position, heard.velocity]).tolist()
    pairs = [
        (by_number[key], pose)
        for key, pose in zip(zip(senders, heard.seq.tolist(), strict=True), got, strict=True)
        if key in by_number
    ]
    assert len(pairs) > 30
    assert all(one == other for one, other in pairs)
    assert np.abs(heard.velocity).max() > 0.05


def test_what_is_said_is_smoothed(delayed_run):
    trace = delayed_run.trace
    drone = trace.robots.index("CF02")
    mine = trace.sent_by(drone)
    at = np.searchsorted(trace.time, mine.stamp - 1e-9)
    off = mine.position - trace.position[at, drone]
    assert 0.002 < np.sqrt((off[:, :2] ** 2).mean()) < 0.03
    assert delayed_run.log.sent.position.shape == delayed_run.log.sent.velocity.shape


def test_belief_error_is_that_of_the_prediction(delayed_run):
    trace, net = delayed_run.trace, delayed_run.plan.links
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


def test_updates_are_counted_for_each_robot():
    run = fly(updating(DELTA, duration_s=12.0, timeline=[]))
    assert run.log.updates[0] == run.log.decisions == 120
    np.testing.assert_array_equal(run.trace.decisions, run.log.updates)
    assert (run.trace.decisions[1:] < 120).all()
    assert (run.trace.decisions[1:] > 10).all()
    assert [robot.updates for robot in run.metrics.robots] == run.trace.decisions.tolist()


SEEDS = (1, 2)  # parameters were chosen on 1001 to 1010


def flights(**parts):
    return [fly(changed(PARK, **parts), seed).metrics for seed in SEEDS]


def ratio(cases, index):
    """Mean of a metric relative to runs that transmit periodically."""
    return np.mean([case.mean[index] for case in cases]) / np.mean([case.mean[index] for case in flights()])


def test_smoothed_prediction_saves_97_percent_and_costs_little():
    predictive = flights(trigger=CHOSEN)
    assert ratio(predictive, "f_hz") <= 0.03
    assert ratio(predictive, "iae") <= 1.02
    assert ratio(predictive, "itae") <= 1.05
    assert all(None not in case.acquired_s for case in predictive)


def test_maximum_silence_stops_runaway_prediction_on_bad_network():
    silence = {**CHOSEN, "maximum_silence_s": 2.0}
    cases = flights(trigger=silence, channel=ChannelTable(delay_s=0.05, loss=0.1))
    assert all(None not in case.acquired_s for case in cases)
    assert ratio(cases, "iae") < 1.03


def test_formation_without_links_has_no_law_to_gate():
    alone = small({"KH01": "khepera4"}, formation=Formation(update="send-on-delta"), duration_s=2.0)
    assert fly(alone).log.updates.tolist() == [20]
