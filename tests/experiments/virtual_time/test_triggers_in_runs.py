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
BAD = ChannelTable(delay_s=0.05, loss=0.1)


def test_prediction_defaults_to_what_the_trigger_needs():
    own = {"prediction": {"kind": "constant-velocity", "horizon_s": 0.5}}
    found = [Plan(changed(PARK, **parts)).predictor for parts in ({}, {"trigger": CHOSEN}, own)]
    assert found == [HOLD, ConstantVelocity(), ConstantVelocity(horizon_s=0.5)]


def updating(update=None, **parts):
    return changed(PARK, formation=changed(PARK.formation, update=update), **parts)


@pytest.mark.parametrize(
    ("change", "path", "hint"),
    [
        ({"trigger": "relative-control"}, "trigger", "update = 'relative-control'"),
        ({"trigger": CHOSEN, "prediction": "hold"}, "prediction", "leave prediction"),
        ({"update": "predictive"}, "formation.update", "relative-control"),
        ({"update": {"kind": "mixed", "smoothing_s": 0.1}}, "formation.update.smoothing_s", "leave it out"),
    ],
)
def test_triggers_where_they_make_no_sense_are_refused(change, path, hint):
    (fault,) = consistency_faults(Plan(updating(**change)))
    assert (".".join(fault.path), hint in fault.hint) == (path, True)


def test_belief_error_is_that_of_the_prediction():
    parts = {"trigger": CHOSEN, "duration_s": 8.0, "timeline": [], "channel": ChannelTable(delay_s=0.05)}
    run = fly(changed(PARK, **parts), 4)
    trace, net = run.trace, run.plan.links
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
    drone = trace.robots.index("CF02")
    mine = trace.sent.take(trace.sent_rows[drone])
    off = mine.position - trace.position[np.searchsorted(trace.time, mine.stamp - 1e-9), drone]
    assert 0.002 < np.sqrt((off[:, :2] ** 2).mean()) < 0.03  # what is sent is smoothed


def test_updates_are_counted_for_each_robot():
    run = fly(updating({"kind": "send-on-delta", "threshold": 0.02}, duration_s=12.0, timeline=[]))
    updates = run.log.updates.tolist()
    assert updates == run.trace.decisions.tolist() == [robot.updates for robot in run.metrics.robots]
    assert updates[0] == run.log.decisions == 120
    assert 10 < min(updates[1:]) <= max(updates[1:]) < 120
    alone = small({"KH01": "khepera4"}, formation=Formation(update="send-on-delta"), duration_s=2.0)
    assert fly(alone).log.updates.tolist() == [20]  # without links there is no law to gate


@pytest.mark.parametrize(
    ("parts", "most"),
    [
        ({"trigger": CHOSEN}, {"f_hz": 0.03, "iae": 1.02, "itae": 1.05}),
        pytest.param(
            {"trigger": {**CHOSEN, "maximum_silence_s": 2.0}, "channel": BAD}, {"iae": 1.03}, marks=pytest.mark.nightly
        ),
    ],
)
def test_smoothed_prediction_saves_97_percent_and_costs_little(parts, most):
    seeds = (1, 2)  # parameters were chosen on 1001 to 1010
    cases, plain = ([fly(changed(PARK, **each), seed).metrics for seed in seeds] for each in (parts, {}))
    assert all(None not in case.acquired_s for case in cases)
    for index, limit in most.items():
        assert sum(case.mean[index] for case in cases) <= limit * sum(case.mean[index] for case in plain)
