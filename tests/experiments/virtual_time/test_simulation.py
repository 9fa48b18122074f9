"""The virtual clock: the same bits from the same seed, names when it gets stuck, faults in trace and recording."""

from dataclasses import fields, replace

import numpy as np
import pytest
from mcap.reader import make_reader
from msgspec import structs

from agents.body.interface import Disturbance
from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING
from agents.network import messages
from agents.network.messages import Contact
from experiments.definition.experiment import (
    Arena,
    ChannelTable,
    Formation,
    LegTable,
    Rates,
    RobotTable,
    Shadow,
    Start,
    WorldTable,
)
from experiments.definition.plan import Plan
from experiments.recording.ros2.payload import unwrap
from experiments.recording.trace import EPOCH
from experiments.virtual_time.conductor import LEAD_S, Stuck
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import VirtualRunLog, simulate
from tests.experiments.checked import findings
from tests.experiments.virtual_time.evaluators import alike, played_back
from tests.runs import fly
from tests.small import changed, pair, reference, small
from twins.engines.engine import Touch
from twins.scene import Obstacle


@pytest.mark.slow
def test_same_seed_gives_same_bits_and_another_others():
    """The reference experiment with everything that is random, cut short."""
    nature = reference().disturbance | {
        "KH02": Disturbance(odometry_drift=0.002, latency_s=0.02),
        "CF02": Disturbance(latency_s=0.03),
    }
    leg = LegTable(at_s=2.0, robot="TB01", plan={"kind": "line", "move_by": [0.2, 0.0], "speed": 0.2})
    trigger = {"kind": "send-on-delta", "threshold": 0.01, "maximum_silence_s": 0.2}
    channel = ChannelTable(delay_s=0.004, jitter_s=0.01, loss=0.2)
    parts = {"disturbance": nature, "timeline": [leg], "trigger": trigger, "channel": channel}
    plan = Plan(changed(reference(), duration_s=4.0, **parts))
    first, again, other = (simulate(plan, seed) for seed in (7, 7, 8))
    for field in fields(VirtualRunLog):
        assert alike(getattr(first, field.name), getattr(again, field.name)), field.name
    assert not np.array_equal(first.position[-1], other.position[-1])
    assert (np.diff(first.phase, axis=0) >= 0).all()
    assert {IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE} >= set(first.phase.ravel().tolist())
    assert (first.true_position[-1, 4:, 2] < 0.03).all()  # down, or about to touch down
    assert (first.true_position[..., 2] >= 0.0).all()


def ground(**parts):
    """Log of two ground robots that listen to each other."""
    return fly(pair(**{"duration_s": 2.0, "trigger": "periodic", **parts})).log


def test_the_common_start_is_time_zero():
    log = ground()
    k = int(np.argmin(np.abs(log.time)))
    assert log.time[k] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(np.diff(log.time), 0.02, atol=1e-9)  # state_hz
    end = int(np.flatnonzero(log.time < 2.0 - 1e-9)[-1])
    assert log.phase[[0, k - 1, k, end]].tolist() == [[IDLE] * 2, [AIRBORNE] * 2, [RUNNING] * 2, [RUNNING] * 2]
    assert (log.phase[end + 1] >= LANDING).all()
    assert (log.airborne, log.decisions, log.ticks) == (pytest.approx(-LEAD_S), 20, 200)
    assert log.ended - log.time[-1] <= 0.02 + 1e-9


def test_losses_are_counted_from_start_to_landing():
    log = ground(channel=ChannelTable(loss=0.25), duration_s=10.0)
    sent, heard = (each.take((each.stamp >= -1e-9) & (each.stamp < 10.0 - 1e-9)) for each in (log.sent, log.received))
    for link, sender in enumerate((1, 0)):
        assert log.lost[link] == (sent.link == sender).sum() - (heard.link == link).sum()
    assert log.lost.sum() / len(sent) == pytest.approx(0.25, abs=0.05)
    log = ground(channel=ChannelTable(loss=1.0))
    stamp = log.received.stamp
    assert not ((stamp > -1e-9) & (stamp < 2.0 - 1e-9)).any()
    assert (stamp.max() >= 2.0 - 1e-9, len(stamp) > 50, log.lost.tolist()) == (True, True, [100, 100])


def test_the_reference_formation_is_acquired():
    run = fly(changed(reference(), duration_s=18.0, timeline=[]))
    leader, *others = [robot.f_hz for robot in run.metrics.robots]
    assert (run.log.incidents, None in run.metrics.acquired_s) == ((), False)
    assert leader < 0.5, "it stands"
    assert 3.0 < np.mean(others[:3]) < np.mean(others[3:]) < max(others) < 20.0


def test_who_keeps_a_run_from_starting_is_named():
    deaf = pair(duration_s=2.0, channel=ChannelTable(delay_s=100.0)), r"not ready after 5 s: A, B \(never received B\)"
    grounded = small({"A": "khepera4", "F": "crazyflie", "G": "crazyflie"}), r"not airborne after 0.5 s: F, G"
    for (experiment, says), patience_s in ((deaf, 5.0), (grounded, 0.5)):
        with pytest.raises(Stuck, match=says):
            simulate(Plan(experiment), 1, patience_s=patience_s)


def test_robot_goes_on_without_a_never_received_neighbour():
    log = ground(channel=ChannelTable(delay_s=100.0), start=Start(deadline_s=1.0, missing="go-on"))
    run = (log.time >= 0.0) & (log.time <= 2.0)
    np.testing.assert_allclose(log.true_position[run], np.tile(log.true_position[0], (run.sum(), 1, 1)), atol=1e-9)
    assert np.isnan(log.error).all(), "of no link"
    assert log.time[0] == pytest.approx(-1.5 - 0.5 - LEAD_S)  # ready after 1 s, sent off at 1.5 s, up, started at 2 s


def hazards(trace):
    return [(event.source, event.text) for event in trace.events if event.kind == "hazard"]


def test_robots_that_come_too_near_hold(tmp_path):
    run = fly(pair(formation=Formation(links={"A - B": 0.3}), safety=Safety(separation=0.6), duration_s=8.0))
    first, second = run.log.true_position[-1]
    assert np.linalg.norm(first - second) > 0.55
    found = hazards(run.trace)
    assert {source for source, _ in found} == {"A", "B"}
    assert ("A", "hold: minimum separation: 0.60 m from B (limit 0.6 m)") in found
    trace, _ = played_back(run.recorder, tmp_path)
    assert all(0.0 < event.stamp <= 8.0 for event in trace.events if event.kind == "hazard")  # unresolved at the end


def with_drone(architecture, low=0.1, **of_drone):
    """Run of a drone that one of two ground robots follows, which has the other one beside it."""
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.3, **of_drone),
        "G": RobotTable(kind="khepera4", start=[1.3, 0.1]),
        "H": RobotTable(kind="khepera4", start=[0.0, 0.9]),
    }
    parts = {"architecture": architecture, "duration_s": 12.0, "safety": Safety(battery_low=low)}
    return fly(small(robots, {"F > G": 0.8, "G - H": 0.9}, **parts))


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
@pytest.mark.parametrize(
    ("low", "planar"),
    [(0.1, np.sqrt(0.8**2 - 0.3**2)), (0.99, 0.89)],  # G stops on its way to a drone that is gone
)
def test_drone_that_lands_is_lost_to_the_formation(architecture, low, planar):
    run = with_drone(architecture, low)
    end = run.log.true_position[np.searchsorted(run.log.time, 11.9), :, :2]
    assert np.linalg.norm(end[1] - end[[0, 2]], axis=1) == pytest.approx([planar, 0.9], abs=0.02)
    landed = low > 0.9
    assert (run.log.phase[np.searchsorted(run.log.time, 11.9)] == DONE).tolist() == [landed, False, False]
    assert not landed or hazards(run.trace)[0] == ("F", "land: its battery is low: 99% (limit 99%)")
    reason = next(iter(run.recorder.statuses())).reason
    assert reason.startswith("land: its battery is low") == landed


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
def test_scripted_landing_silences_and_loses_a_robot(architecture):
    run = with_drone(architecture, lands_at_s=4.0)
    log = run.log
    assert log.time[np.argmax(log.phase[:, 0] == LANDING)] == pytest.approx(4.0, abs=0.03)
    assert log.phase[np.searchsorted(log.time, 9.0)].tolist() == [DONE, RUNNING, RUNNING]
    assert log.sent.stamp[log.sent.link == 0].max() < 4.03
    assert architecture == "centralised" or ("G", "warn: a neighbour is lost: F") in hazards(run.trace)
    reasons = [status.reason for status in run.recorder.statuses()]
    assert reasons[:3] == ["lands as its file says", "finished", "finished"]
    assert not run.metrics.failures


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"battery_low": 0.5}, "battery"),
        ({"cut_beyond_m": 0.2}, "cut-outside"),
        ({"position_timeout_s": 500.0}, "loose-limit"),
        ({"separation": 0.9}, "separation-start"),
        ({"separation": 0.6}, "separation-link"),
    ],
)
def test_check_finds_settings_that_make_no_sense(settings, code):
    assert code in findings(pair(safety=Safety(**settings), duration_s=20.0))


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
    ends = (-0.4, 1, -1), (0.503, 0, 1), (1.25, 0, -2), (2.5, 1, -3), (3.2, 1, 0)  # the first and last out of the run
    touches = tuple(Touch(*end, 0.1 * k, 0.001 * k) for k, end in enumerate(ends, start=1))
    counts = np.array([4, 3])
    return replace(plain, attitude=attitude, touches=touches, interventions=counts, avoided=counts // 2)


def test_logged_and_played_back_runs_are_the_same(log, tmp_path):
    trace, _ = played_back(recorder(log), tmp_path)
    assert trace.dropped.sum() > 50
    assert np.isfinite(trace.shadow_position).all(axis=(0, 2)).tolist() == [True, False]


def test_recorded_poses_are_those_that_robots_send(log, tmp_path):
    """Numbers in the middle of two that can be sent, and next to it; unknown ones; yaws beyond a turn."""
    dice, count = np.random.default_rng(1), len(log.sent)
    middle = dice.integers(-(10**8), 10**8, (2, count, 3)) * 5e-7
    place, velocity = np.nextafter(middle, middle + dice.integers(-1, 2, middle.shape))
    velocity[::7, 1] = np.nan
    yaw = np.where(np.arange(count) % 5, dice.uniform(-20.0, 20.0, count), np.nan)
    sent = structs.replace(log.sent, position=place, velocity=velocity, yaw=yaw)
    recorder(replace(log, sent=sent)).record(tmp_path / "run.mcap", "")
    with (tmp_path / "run.mcap").open("rb") as file:
        found = make_reader(file).iter_messages(["/KH/pose", "/CF/pose"], log_time_order=False)
        payloads = [unwrap(message.data, "json") for *_, message in found]
    rows = zip(sent.link, sent.seq.tolist(), EPOCH + sent.stamp, place, velocity, yaw, strict=True)
    assert payloads == [
        messages.encode(messages.pose(log.names[row], seq, t, x.tolist(), v.tolist(), yaw=turn))
        for row, seq, t, x, v, turn in rows
    ]


def test_a_trace_has_contacts_and_moving_things(log):
    trace = recorder(log).trace()
    touched = (0.503, "KH", "CF"), (1.25, "KH", "cart"), (2.5, "CF", "wall")
    wanted = [Contact(pytest.approx(at), *ends, 0.1 * k, 0.001 * k) for k, (at, *ends) in enumerate(touched, start=2)]
    assert [*trace.contacts] == pytest.approx(wanted)
    assert (trace.interventions.tolist(), trace.avoided.tolist()) == ([4, 3], [2, 1])
    world = trace.world
    assert [(round(said.stamp, 6), said.contacts) for said in world] == [(0.0, 1), (1.0, 2), (2.0, 3), (3.0, 4)]
    assert [[standing.name for standing in said.obstacles] for said in world] == [["post", "cart"]] * 4
    assert [said.obstacles[1].pose[0] for said in world] == pytest.approx([-0.8, -0.7, -0.6, -0.5])
    known = {(said.obstacles[0].pose, said.engine, said.factor, said.paused) for said in world}
    assert known == {((1.0, 1.0, 0.0), "point-mass", 1.0, False)}


def test_engine_without_contacts_found_reports_none(log):
    quiet = replace(log, touches=())
    assert [recorder(quiet, engine).trace().contacts for engine in ("point-mass", "pymunk")] == [None, ()]
    trace = recorder(replace(quiet, obstacles=log.obstacles[:, :, :0]), arena=Arena()).trace()
    assert (trace.world, trace.contacts) == ((), None)
