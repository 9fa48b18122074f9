"""Detection of hazards: causes as robots meet them, and whatever happens a robot ends up stopped or landed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body.interface import BodyState, Rays
from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, DONE, LANDING, READY, RUNNING
from agents.safety.detection import SLOWEST, Descent, tilt_angle, tilted
from agents.safety.hazards import Outcome
from agents.safety.landing import PATIENCE_S
from agents.safety.situation import LATE_SHARE, ProcessHealth
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import drone, pair, triangle
from tests.agents.swarm import Swarm
from tests.agents.things import poses

DT = 0.01


def happened(swarm):
    """Texts of hazards, by robot."""
    return {
        name: [each.text for each in group.agent.hazards.incidents if each.row == row]
        for name, (group, row) in swarm.where.items()
    }


def spoiled(swarm, **values):
    """From now on the bodies of the first group say this."""
    group = swarm.groups[0]

    def spoil(t, state):
        for name, value in values.items():
            was = getattr(state, name)
            if isinstance(was, tuple):
                setattr(state, name, value)
            elif was is None:
                setattr(state, name, np.tile(np.asarray(value, dtype=float), (len(state.yaw), 1)))
            else:
                was = was.copy()
                was[:] = value
                setattr(state, name, was)
        return state

    group.spoil = spoil


def leant(angle):
    return [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]


UNSAFE = {
    "tipped": ({"attitude": leant(1.3)}, "cut: it has tipped over: it leans 74° (limit 69°)", DONE, 12),
    "level enough": ({"attitude": leant(1.1)}, None, RUNNING, 300),
    "unknown": ({"attitude": [np.nan] * 4}, None, RUNNING, 300),
    "empty": ({"battery": 0.09}, "land: its battery is low: 9% (limit 10%)", LANDING, 102),
    "no gauge": ({"battery": np.nan}, None, RUNNING, 300),
    "too fast": ({"velocity": [0.0, 4.4, 0.0]}, "hold: it moves faster than it can: 4.40 m/s", LANDING, 102),
    "fast": ({"velocity": [0.0, 4.2, 0.0]}, None, RUNNING, 300),
    "outside": ({"position": [2.3, 0.0, 0.5]}, "land: it left the arena: 0.30 m outside (limit 0.25 m)", LANDING, 2),
    "flown": ({"position": [2.8, 0.0, 0.5]}, "cut: it flies away: 0.80 m outside (limit 0.75 m)", DONE, 13),
    "beyond": ({"position": [2.1, 0.0, 0.5]}, "warn: it is beyond a wall of the arena: 0.10 m outside", RUNNING, 50),
    "sinks": (
        {"position": [0.0, 0.0, 0.3], "velocity": [0.0, 0.0, -0.2]},
        "land: it comes down by itself: 0.20 m below its goal, and sinks at 0.20 m/s",
        LANDING,
        13,
    ),
    "low": ({"position": [0.0, 0.0, 0.3], "velocity": [0.0, 0.0, -0.1]}, None, RUNNING, 150),
    "dips": ({"position": [0.0, 0.0, 0.4], "velocity": [0.0, 0.0, -0.2]}, None, RUNNING, 300),
    "down": ({"flying": False}, "land: it came down by itself: its motors are off", LANDING, 2),
}


@pytest.mark.parametrize("what", UNSAFE)
def test_a_drone_that(what):
    values, text, phase, ticks = UNSAFE[what]
    swarm = drone().running().run(0.3)
    swarm.agent("F").resume(0)  # it is put there: no jump
    spoiled(swarm, **values)
    swarm.run(0.01)
    assert swarm.phase("F") in (RUNNING, LANDING, phase)
    for _ in range(ticks - 1):
        swarm.step()
        if swarm.phase("F") >= phase > RUNNING:
            break
    assert swarm.phase("F") == phase
    told = happened(swarm)["F"]
    assert any(each.startswith(text) for each in told) if text else told == []


@pytest.mark.parametrize(("samples", "phase"), [(1, RUNNING), (2, DONE)])
def test_a_lean_takes_two_samples(samples, phase):
    swarm = drone().running().run(0.3)
    for sample in range(samples):  # telemetry that stops with the last one
        spoiled(swarm, attitude=leant(1.4), time=swarm.t + 0.01 * sample)
        swarm.step()
    swarm.run(0.3)
    assert swarm.phase("F") == phase


def test_wheels_whose_yaw_jumps_stand():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.3)
    group = swarm.groups[0]
    group.spoil = lambda t, state: replace(state, yaw=state.yaw + 1.2)
    swarm.run(0.5)
    assert any("its yaw jumped by 1.2" in text for text in happened(swarm)["A"])
    place = group.state.true_position.copy()
    swarm.run(1.0)
    assert group.state.true_position == pytest.approx(place, abs=1e-3)
    assert swarm.agent("A").start(0, swarm.t) == ""
    swarm.run(0.1)
    assert not swarm.agent("A").hazards.held[0]


def test_wheels_whose_position_is_old_know_no_error():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.3)
    assert np.isfinite(swarm.agent("A").error).all()
    spoiled(swarm, time=swarm.t)
    swarm.run(0.4)
    assert np.isfinite(swarm.agent("A").error).all()
    swarm.run(0.3)
    assert np.isnan(swarm.agent("A").error).all()
    assert np.isfinite(swarm.agent("B").error).all()


def test_a_drone_that_is_carried_aside_while_it_climbs_lands():
    swarm = drone().run(0.1)
    assert swarm.agent("F").lifecycle.takeoff(0) == ""
    group, begin = swarm.groups[0], swarm.t

    def carried(t, state):
        state.position[:, 0] += 1.0 * (t - begin)
        return state

    group.spoil = carried
    swarm.run(0.5)
    assert not happened(swarm)["F"]
    swarm.run(0.1)
    assert happened(swarm)["F"] == ["land: it moves and is not told to: 0.57 m aside while it climbs"]


@pytest.mark.parametrize(("kind", "patience_s"), [("crazyflie", 4.0), ("tello", 10.0)])
def test_a_climb_lands_if_its_measured_height_stays(kind, patience_s):
    robots = {"F": Robot(kind=kind, start=[0.1, 0.2], hover=0.5)}
    swarm = Swarm(pair(robots=robots, formation=Formation())).run(0.1)
    assert swarm.agent("F").lifecycle.takeoff(0) == ""
    swarm.run(0.1)
    noise = np.random.default_rng(1)

    def fallen_markers(t, state):
        state.position[0] = [0.1, 0.2, 0.02] + 5e-4 * noise.standard_normal(3)
        state.velocity[0] = 0.0
        return state

    swarm.groups[0].spoil = fallen_markers
    swarm.run(patience_s - 0.2)
    assert not happened(swarm)["F"]
    swarm.run(0.3)
    assert happened(swarm)["F"] == ["land: it is told to move and does not: it does not rise"]


@pytest.mark.parametrize("ahead_s", [0.3, 100.0, np.inf])
def test_a_silent_body_whose_clock_is_ahead_lands(ahead_s):
    swarm = drone().running().run(0.3)
    before = swarm.groups[0].state
    spoiled(swarm, time=before.time + ahead_s, position=before.position, velocity=before.velocity)
    swarm.run(1.5)
    assert swarm.phase("F") >= LANDING


def jumped(swarm, name, at, until, off=1.0):
    """The measured position of a robot is `off` [m] from `at` [s] on, before `until`."""
    group = next(group for group in swarm.groups if name in group.names)

    def spoil(t, state):
        if at <= t < until:
            state.position[group.names.index(name), 1] += off
        return state

    group.spoil = spoil


@pytest.mark.parametrize(("lasts_s", "phase"), [(0.01, RUNNING), (0.25, RUNNING), (0.5, LANDING)])
def test_a_drone_whose_position_jumps_lands_unless_it_is_back_at_once(lasts_s, phase):
    swarm = drone().running().run(0.3)
    place = swarm.row("F", "truth")
    jumped(swarm, "F", swarm.t, swarm.t + lasts_s)
    swarm.run(2.0)
    assert swarm.phase("F") >= phase
    assert swarm.phase("F") == RUNNING or phase == LANDING
    first = happened(swarm)["F"][0]
    assert first.startswith("hold: its own position is lost: it jumped by 1.0")
    assert np.linalg.norm((swarm.row("F", "truth") - place)[:2]) < 0.1


@pytest.mark.parametrize("begins", ["climbing", "running", "landing"])
def test_a_position_far_away_that_was_refused_cuts_no_motors(begins):
    swarm = drone()
    if begins == "climbing":
        swarm.run(0.1)
        while swarm.row("F", "truth")[2] < 0.2:
            swarm.conduct()
            swarm.step()
    else:
        swarm.running().run(0.3)
    if begins == "landing":
        swarm.agent("F").lifecycle.land(0, "by a test")
        swarm.run(0.2)
    jumped(swarm, "F", swarm.t, np.inf, off=1e5)
    while swarm.phase("F") != DONE:
        swarm.step()
        assert np.isnan(swarm.agent("F").state.position[0]).all()
    assert swarm.row("F", "truth")[2] < 0.05  # it has landed
    assert not any("flies away" in text for text in happened(swarm)["F"])


@pytest.mark.slow
def test_wheels_whose_position_jumps_stand_and_lead_nobody_astray_until_they_are_ordered_to_start():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(10.0)
    before = [swarm.row(name, "truth") for name in ("A", "B")]
    jumped(swarm, "A", swarm.t, np.inf)
    swarm.run(20.0)
    after = [swarm.row(name, "truth") for name in ("A", "B")]
    assert np.abs(np.array(after) - before).max() < 0.01
    assert happened(swarm)["A"] == ["hold: its own position is lost: it jumped by 1.00 m"]
    assert happened(swarm)["B"] == []
    swarm.agent("A").resume(0)
    swarm.run(2.0)
    assert happened(swarm)["A"][-1].startswith("over: its own position is lost, after 19.9")
    assert swarm.row("A", "setpoint").any()  # it believes its position


def test_two_that_come_too_near_hold_and_go_on_when_one_is_taken_away():
    experiment = pair(formation=Formation(links={"A - B": 0.3}), safety=Safety(separation=0.5))
    swarm = Swarm(experiment, [["A"], ["B"]]).running().run(12.0)
    place = swarm.column("truth")
    apart = np.linalg.norm(place[:, 0] - place[:, 1], axis=1)
    assert apart[-1] > 0.45
    assert np.ptp(place[-200:], axis=0).max() < 1e-3  # they stand
    told = happened(swarm)
    assert told["A"][0].startswith("hold: minimum separation: 0.50 m from B (limit 0.5 m)")
    assert len(told["A"]) == len(told["B"]) == 1
    agent = swarm.agent("A")
    for k in range(80):  # B is somewhere else now
        agent.neighbours.receive(
            poses(np.array([0]), np.array([[1.5, 0.0, 0.0]]), np.zeros((1, 3)), *np.full((2, 1), 99.0 + k))
        )
        swarm.groups[0].by_speaker.clear()
        swarm.step()
    assert swarm.row("A", "setpoint").any()


def test_two_that_nearly_touch_land():
    experiment = pair(safety=Safety(separation=0.3))
    swarm = Swarm(experiment, [["A"], ["B"]]).running().run(0.5)
    here = swarm.row("A", "position") + np.array([0.14, 0.0, 0.0])
    swarm.agent("A").neighbours.receive(
        poses(np.array([0]), here[None], np.zeros((1, 3)), np.array([99.0]), np.array([99.0]))
    )
    swarm.step()
    swarm.step()
    assert swarm.phase("A") >= LANDING
    assert swarm.agent("A").lifecycle.reason == ["far too near to another robot"]
    assert swarm.phase("B") == RUNNING  # it knows better where it is itself


@pytest.mark.parametrize(
    ("choice", "phase", "moves"), [("drop", RUNNING, True), ("hold", RUNNING, False), ("land", LANDING, False)]
)
def test_a_neighbour_that_is_lost(choice, phase, moves):
    experiment = triangle(safety=Safety(lost_neighbour=choice))
    swarm = Swarm(experiment, [["A"], ["B"], ["C"]]).running().run(0.5)
    swarm.agent("A").neighbours.mark_lost(np.array([0]), swarm.t)
    swarm.groups[0].by_speaker.pop("B")
    swarm.run(1.0)
    assert happened(swarm)["A"] == []
    swarm.run(0.03)
    assert happened(swarm)["A"] == [f"{'warn' if choice == 'drop' else choice}: a neighbour is lost: B"]
    before = swarm.row("A", "truth")
    swarm.run(1.0)
    assert min(swarm.phase("A"), LANDING) == phase
    assert (np.linalg.norm(swarm.row("A", "truth") - before) > 0.01) == moves
    if choice == "hold":
        swarm.agent("A").neighbours.mark_alive(np.array([0]))
        swarm.run(1.2)
        assert happened(swarm)["A"][-1].startswith("over: a neighbour is lost, after ")


def test_without_a_router_it_holds_and_then_lands():
    swarm = drone(safety=Safety(offline_s=3.0)).running().run(0.2)
    swarm.agent("F").health.offline_since = swarm.t
    swarm.run(2.9)
    assert happened(swarm)["F"] == ["hold: no connection to a router: for 1.0 s"]
    assert swarm.phase("F") == RUNNING
    swarm.run(0.15)
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (LANDING, ["no connection to a router"])


@pytest.mark.parametrize(("choice", "phase"), [("finish", RUNNING), ("land", LANDING)])
def test_without_a_conductor(choice, phase):
    swarm = drone(safety=Safety(lost_conductor=choice)).running().run(0.2)
    swarm.agent("F").health.conductor_lost_since = swarm.t
    swarm.run(1.9)
    assert happened(swarm)["F"] == []
    swarm.run(0.2)
    assert swarm.phase("F") == phase
    assert "the conductor is gone: for 2.0 s" in happened(swarm)["F"][0]


@pytest.mark.parametrize("avoids", [True, False])
def test_wheels_whose_range_sensor_dies_hold(avoids):
    robots = {"A": Robot(kind="turtlebot3", start=[-1.0, 0.0])}
    swarm = Swarm(
        pair(robots=robots, formation=Formation(), **({"avoidance": "potential"} if avoids else {}))
    ).running()
    none = np.zeros(4)
    scans = {"last": None}

    def scanner(t, state):
        if t < 3.0:
            scans["last"] = Rays(none.astype(np.intp), none + t, np.linspace(0.0, 3.0, 4), none, none + np.nan)
        state.rays = scans["last"] if t < 5.0 else None  # old ones are dropped
        return state

    swarm.groups[0].spoil = scanner
    swarm.run(3.9 - swarm.t)
    assert swarm.agent("A").go(0, (1.0, 0.0), swarm.t) == ""
    assert not happened(swarm)["A"]
    swarm.run(6.0)
    assert happened(swarm)["A"] == (["hold: its range sensors are silent: for 1.0 s"] if avoids else [])
    assert (swarm.row("A", "truth")[0] < -0.9) == avoids


def test_a_drone_that_nobody_starts_lands():
    swarm = drone(safety=Safety(offline_s=3.0)).run(0.1)
    assert swarm.agent("F").lifecycle.takeoff(0) == ""
    swarm.run(5.0)
    assert swarm.phase("F") == AIRBORNE
    swarm.agent("F").health.conductor_lost_since = swarm.t
    swarm.run(2.9)
    assert swarm.phase("F") == AIRBORNE
    swarm.run(0.2)
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (LANDING, ["nobody will start it"])


def test_a_control_loop_that_hardly_runs_holds_and_then_lands():
    outside = ProcessHealth()
    for _ in range(500):
        outside.count_tick(4, DT)
    assert outside.missed_share == pytest.approx(0.8)  # 20 Hz is slow, not hopeless
    outside.count_tick(500, DT)  # 5 s of nothing
    assert outside.missed_share > LATE_SHARE
    for _ in range(20):
        outside.count_tick(0, DT)
    assert outside.missed_share < LATE_SHARE
    for _ in range(2000):
        outside.count_tick(0, DT)
    assert outside.missed_share == 0.0
    swarm = drone().running().run(0.2)
    agent = swarm.agent("F")
    for _ in range(30):
        agent.health.count_tick(30, DT)
        swarm.tick += 30
        swarm.step()
    assert swarm.phase("F") >= LANDING
    assert agent.lifecycle.reason == ["its control loop misses its ticks"]


def test_a_law_that_wants_nonsense_lands():
    swarm = drone().running().run(0.2)
    group = swarm.groups[0]
    group.agent.goal_computer.decide = lambda *_, **__: pytest.fail("not asked")  # the goal stays what it is
    group.agent._decide = lambda *_: group.agent.goal.__setitem__(slice(None), np.nan)
    swarm.run(1.0)
    assert happened(swarm)["F"][0] == "hold: what it wants is not a setpoint: not made of finite numbers"
    assert swarm.agent("F").lifecycle.reason == ["what it wants is not a setpoint"]
    assert swarm.phase("F") >= LANDING


def landing(**values):
    """A drone that is told to land after 0.2 s, with `landing_s` 2, and whose body says this."""
    swarm = drone(safety=Safety(landing_s=2.0)).running().run(0.2)
    swarm.agent("F").lifecycle.land(0, "ordered to land")
    spoiled(swarm, **values)
    return swarm


@pytest.mark.parametrize(
    "values",
    [{"flying": True}, {"flying": True, "position": np.nan}, {"flying": True, "velocity": [0.0, 0.0, 0.5]}],
    ids=["on the floor", "blind", "climbs"],
)
def test_a_landing_drone_that_does_no_good_is_cut(values):
    """Landings with motors that stay on, without a position, or that move and do not descend."""
    swarm = landing(**values, **({"position": [0.0, 0.0, 0.5]} if "velocity" in values else {}))
    swarm.run(1.9)
    assert swarm.phase("F") == LANDING
    # without a position it may be below the ceiling
    swarm.run(5.0 if np.isfinite(values.get("position", 0.0)).all() else swarm.experiment.arena.size[2] / SLOWEST + 2.0)
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (DONE, ["its landing takes too long"])


def test_a_blind_drone_gets_the_time_of_its_room():
    descent, landing = Descent(1, 6.0), np.ones(1, dtype=bool)
    blind = BodyState(*np.full((8, 1), np.nan))
    blind.position = blind.velocity = np.full((1, 3), np.nan)
    cut = [tick for tick in range(400) if descent.update(0.1 * tick, landing, ~landing, blind)[0].any()]
    assert cut[0] == 301  # 6 m at 0.2 m/s


@pytest.mark.slow
def test_a_landing_drone_that_hovers_is_never_cut():
    swarm = landing(flying=True, position=[0.0, 0.0, 0.5], velocity=[0.0, 0.0, 0.0]).run(30.0)
    assert swarm.phase("F") == LANDING
    assert "warn: it is told to land and hovers: at 0.50 m" in happened(swarm)["F"]


@pytest.mark.slow
def test_a_landing_that_takes_long_is_given_its_time():
    swarm = landing(flying=True)
    group = swarm.groups[0]
    spoil, begin = group.spoil, swarm.t

    def sinks(t, state):
        state = spoil(t, state)
        state.position[:, 2] = 1.0 - 0.03 * (t - begin)
        state.velocity[:] = 0.0, 0.0, -0.03
        return state

    group.spoil = sinks
    swarm.run(30.0)
    assert swarm.phase("F") == LANDING
    assert not any("land" in text for text in happened(swarm)["F"])


@pytest.mark.parametrize(
    "attitude", [[1.0, 0.7, 0.0, 0.0], [10.0, 0.8, 0.0, 0.0], [0.0] * 4, [np.nan] * 4, [1e200] * 4]
)
def test_what_is_no_rotation_is_no_tilt(attitude):
    assert not tilted(np.array([attitude]), 1.2).any()


def test_leaning_is_an_angle_to_the_vertical():
    attitude = np.array([leant(0.5), [math.cos(0.6), 0.0, 0.0, math.sin(0.6)], [0.0, 1.0, 0.0, 0.0], [np.nan] * 4])
    assert [round(tilt_angle(attitude, row), 6) for row in range(3)] == [0.5, 0.0, round(math.pi, 6)]
    assert tilted(attitude, 0.49).tolist() == [True, False, True, False]


# ---------------------------------------------------------------- whatever happens

number = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([np.nan, 0.0, 9.0, 1e9]))
SPOILT = st.fixed_dictionaries(
    {},
    optional={
        "position": st.tuples(number, number, number),
        "velocity": st.tuples(number, number, number),
        "yaw": number,
        "battery": st.one_of(st.floats(0.0, 1.0), st.just(np.nan)),
        "attitude": st.sampled_from([leant(a) for a in (0.0, 1.0, 2.0)] + [[np.nan] * 4]),
        "flying": st.booleans(),
    },
)
EVENTS = st.sampled_from(["lose", "find", "offline", "online", "unattended", "skip", "hold", "start", "nothing"])


def occur(agent, event, t):
    """Something happens around a decision."""
    outside = agent.health
    match event:
        case "lose":
            agent.neighbours.mark_lost(np.arange(2), t)
        case "find":
            agent.neighbours.mark_alive(np.arange(2))
        case "offline" | "online":
            outside.offline_since = t if event == "offline" else np.inf
        case "unattended":
            outside.conductor_lost_since = t
        case "skip":
            agent.skip_ticks(200)
        case "hold":
            agent.hold(0)
        case "start":
            agent.start(0, t)


@pytest.mark.slow
@settings(max_examples=10)
@given(
    st.lists(st.tuples(SPOILT, EVENTS, st.integers(1, 80)), max_size=8),
    st.sampled_from(["drop", "hold", "land"]),
    st.booleans(),
)
def test_whatever_happens_nobody_comes_up_again(story, lost, early):
    robots = {"F": Robot(kind="crazyflie", start=[0.1, 0.2], hover=0.5), "G": Robot(kind="khepera4", start=[0.9, 0.1])}
    safety = Safety(lost_neighbour=lost, separation=0.4, offline_s=2.0)
    swarm = Swarm(pair(robots=robots, formation=Formation(links={"F - G": 0.8}), safety=safety, duration_s=20.0))
    swarm.until(READY if early else RUNNING)
    (group,) = swarm.groups
    agent = group.agent
    if early:
        agent.lifecycle.takeoff(0), agent.lifecycle.takeoff(1)
    before, lands = agent.lifecycle.phase.copy(), swarm.t
    for values, event, ticks in story:
        spoiled(swarm, **values)
        occur(agent, event, swarm.t)
        for _ in range(ticks):
            swarm.step()
            phase, setpoint = agent.lifecycle.phase, group.actions.setpoint
            down = before >= LANDING
            lands = swarm.t if phase[0] < LANDING else lands
            assert (phase[down] >= before[down]).all()
            assert np.isnan(setpoint[0]).all() or np.isfinite(setpoint[0]).all()
            assert np.isfinite(setpoint[1]).all()
            for row in range(2):
                if agent.hazards.outcome(row) >= Outcome.LAND:
                    assert phase[row] >= LANDING
                    assert agent.lifecycle.reason[row]
            ended = (phase < AIRBORNE) | (phase >= LANDING)
            assert not setpoint[1].any() or not ended[1]
            aside = swarm.t <= lands + PATIENCE_S + DT  # who comes down beside a robot goes there at its height
            assert np.isnan(setpoint[0]).all() or not ended[0] or (phase[0] == LANDING and aside)
            before = phase.copy()
    spoiled(swarm, position=np.nan)  # and now nothing is known any more
    swarm.run(3.0)
    assert agent.lifecycle.phase[0] in (LANDING, DONE) or agent.lifecycle.phase[0] <= READY
    assert not group.actions.setpoint[1].any()
