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


@pytest.mark.parametrize(
    ("parts", "predictor"),
    [
        ({}, HOLD),
        ({"trigger": CHOSEN}, ConstantVelocity()),
        ({"prediction": {"kind": "constant-velocity", "horizon_s": 0.5}}, ConstantVelocity(horizon_s=0.5)),
    ],
)
def test_prediction_defaults_to_what_the_trigger_needs(parts, predictor):
    assert Plan(changed(PARK, **parts)).predictor == predictor


def updating(update=None, **parts):
    return changed(PARK, formation=changed(PARK.formation, update=update), **parts)


SMOOTH = {"kind": "mixed", "smoothing_s": 0.1}


@pytest.mark.parametrize(
    ("change", "path", "hint"),
    [
        ({"trigger": "relative-control"}, "trigger", "update = 'relative-control'"),
        ({"trigger": CHOSEN, "prediction": "hold"}, "prediction", "leave prediction"),
        ({"update": "predictive"}, "formation.update", "relative-control"),
        ({"update": SMOOTH}, "formation.update.smoothing_s", "leave it out"),
    ],
)
def test_triggers_where_they_make_no_sense_are_refused(change, path, hint):
    (fault,) = consistency_faults(Plan(updating(**change)))
    assert ".".join(fault.path) == path
    assert hint in fault.hint


@pytest.fixture(scope="module")
def delayed_run():
    """A short run with the chosen trigger on a network with a delay."""
    parts = {"trigger": CHOSEN, "duration_s": 8.0, "timeline": [], "channel": ChannelTable(delay_s=0.05)}
    return fly(changed(PARK, **parts), 4)


def test_what_is_said_is_smoothed(delayed_run):
    trace = delayed_run.trace
    drone = trace.robots.index("CF02")
    mine = trace.sent_by(drone)
    at = np.searchsorted(trace.time, mine.stamp - 1e-9)
    off = mine.position - trace.position[at, drone]
    assert 0.002 < np.sqrt((off[:, :2] ** 2).mean()) < 0.03
    assert np.abs(mine.velocity).max() > 0.05


def test_belief_error_is_that_of_the_prediction(delayed_run):
    trace, net = delayed_run.trace, delayed_run.plan.links
    found = signals.belief_errors(trace, net)
    heard, ends = trace.received, trace.plan.pose_links
    for link in np.flatnonzero(net.sender > 0)[::5]:  # the leader stands, and says nothing after the start
        asked = (ends.receiver == net.receiver[link]) & (ends.sender == net.sender[link])
        mine = np.flatnonzero(asked[heard.link])
        for k in (150, 300, 399):
            last = mine[heard.arrival[mine] <= trace.time[k]][-1]
            ahead = heard.position[last] + heard.velocity[last] * (trace.time[k] - heard.stamp[last])
            wanted = math.dist(ahead, trace.true_position[k, net.sender[link]])
            assert found[k, link] == pytest.approx(wanted, abs=1e-12)
    held = dataclasses.replace(trace, plan=trace.plan.changed(trigger="send-on-delta"))
    assert np.nanmean(signals.belief_errors(held, net) ** 2) > 4.0 * np.nanmean(found**2)


def test_updates_are_counted_for_each_robot():
    run = fly(updating({"kind": "send-on-delta", "threshold": 0.02}, duration_s=12.0, timeline=[]))
    assert run.log.updates[0] == run.log.decisions == 120
    np.testing.assert_array_equal(run.trace.decisions, run.log.updates)
    assert (run.trace.decisions[1:] < 120).all()
    assert (run.trace.decisions[1:] > 10).all()
    assert [robot.updates for robot in run.metrics.robots] == run.trace.decisions.tolist()
    alone = small({"KH01": "khepera4"}, formation=Formation(update="send-on-delta"), duration_s=2.0)
    assert fly(alone).log.updates.tolist() == [20]  # without links there is no law to gate


def flights(**parts):
    """Two seeds; parameters were chosen on 1001 to 1010."""
    return [fly(changed(PARK, **parts), seed).metrics for seed in (1, 2)]


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
