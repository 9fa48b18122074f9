"""A virtual run as it is logged, and read back from its recording, is the same trace."""

from dataclasses import fields, replace

import numpy as np
import pytest

from agents.body.interface import Disturbance
from experiments.definition.experiment import Arena, ChannelTable, LegTable, Rates, RobotTable, Shadow, WorldTable
from experiments.definition.plan import Plan
from experiments.recording import playback
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate
from tests.experiments.virtual_time.evaluators import alike
from tests.small import small
from twins.engines.engine import Touch
from twins.scene import Obstacle

CART = Obstacle(box=(0.2, 0.2), at=(-0.8, 0.8), plan={"kind": "line", "move_by": [0.5, 0.0], "speed": 0.1})


def mixed_pair(engine="point-mass", **parts):
    robots = {
        "KH": RobotTable(kind="khepera4", start=[-0.4, 0.0], shadow=Shadow(restart_s=1.0)),
        "CF": RobotTable(kind="crazyflie", start=[0.4, 0.1], hover=0.5),
    }
    given = {
        "duration_s": 3.0,
        "arena": Arena(obstacles={"post": Obstacle(radius=0.1, at=(1.0, 1.0)), "cart": CART}),
        "disturbance": {"all": Disturbance(position_sigma=0.001, yaw_sigma=0.002)},
        "channel": ChannelTable(delay_s=0.02, loss=0.2),
        "rates": Rates(state_hz=50.0),
        "timeline": [LegTable(at_s=1.0, robot="CF", plan={"kind": "line", "move_by": [0.2, 0.0], "speed": 0.2})],
        "world": WorldTable(engine=engine),
    }
    return small(robots, {"KH - CF": 0.7}, **given | parts)


def recorder(log, engine="point-mass", **parts):
    return RunRecorder(log, Plan(mixed_pair(engine, **parts)), "only")


@pytest.fixture(scope="module")
def log():
    """Log of a run, with attitudes and contacts of the test, which this engine does not compute."""
    plain = simulate(Plan(mixed_pair()), 3)
    half = np.linspace(0.0, 2.0, len(plain.time))[:, None] * [1.0, 0.5]
    attitude = np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=-1)
    touches = (
        Touch(-0.4, 1, -1, 0.1, 0.001),  # before the start
        Touch(0.503, 0, 1, 0.2, 0.002),
        Touch(1.25, 0, -2, 0.3, 0.003),
        Touch(2.5, 1, -3, 0.4, 0.004),
        Touch(3.2, 1, 0, 0.5, 0.005),  # after the end
    )
    counts = np.array([4, 3])
    return replace(plain, attitude=attitude, touches=touches, interventions=counts, avoided=counts // 2)


def test_logged_and_played_back_runs_are_the_same(log, tmp_path):
    book = recorder(log)
    book.record(tmp_path / "run.mcap", "")
    played, trace = playback.read(tmp_path / "run.mcap"), book.trace()
    assert played.complete
    for field in fields(trace):
        assert alike(getattr(trace, field.name), getattr(played.trace, field.name), 2e-6), field.name
    assert trace.dropped.sum() > 50
    assert np.isfinite(trace.shadow_position).all(axis=(0, 2)).tolist() == [True, False]


def test_a_trace_has_contacts_and_moving_things(log):
    trace = recorder(log).trace()
    assert [(c.stamp, c.first, c.second, c.impulse, c.overlap) for c in trace.contacts] == [
        (pytest.approx(0.503), "KH", "CF", 0.2, 0.002),
        (pytest.approx(1.25), "KH", "cart", 0.3, 0.003),
        (pytest.approx(2.5), "CF", "wall", 0.4, 0.004),
    ]
    assert (trace.interventions.tolist(), trace.avoided.tolist()) == ([4, 3], [2, 1])
    world = trace.world
    assert [round(said.stamp, 6) for said in world] == [0.0, 1.0, 2.0, 3.0]
    assert [[standing.name for standing in said.obstacles] for said in world] == [["post", "cart"]] * 4
    assert [said.obstacles[1].pose[0] for said in world] == pytest.approx([-0.8, -0.7, -0.6, -0.5])
    assert {said.obstacles[0].pose for said in world} == {(1.0, 1.0, 0.0)}
    assert [said.contacts for said in world] == [1, 2, 3, 4]
    assert {(said.engine, said.factor, said.paused) for said in world} == {("point-mass", 1.0, False)}


def test_engine_without_contacts_found_reports_none(log):
    quiet = replace(log, touches=())
    assert [recorder(quiet, engine).trace().contacts for engine in ("point-mass", "pymunk")] == [None, ()]
    trace = recorder(replace(quiet, obstacles=log.obstacles[:, :, :0]), arena=Arena()).trace()
    assert (trace.world, trace.contacts) == ((), None)
