"""The decision: a swarm of one, neighbours that go and come back, orders, and what is done when little is known."""

import msgspec
import numpy as np
import pytest

from agents.agent import Agent
from agents.body import BodyState, Disturbance, Jitter
from agents.hearing import Heard
from agents.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING, Phase
from experiments import assign, document
from experiments.experiment import Formation, Leg, Robot, Start
from tests.agents.swarm import Swarm, changed

PERIODIC = {"kind": "periodic", "period_s": 0.02}
NOISY = {
    "all": Disturbance(position_sigma=0.0005, yaw_sigma=0.002),
    "crazyflie": Disturbance(hover_jitter=Jitter(0.01)),
    "KH03": Disturbance(latency_s=0.05, odometry_drift=0.002),
    "CF02": Disturbance(latency_s=0.02),
}


@pytest.fixture(scope="module")
def park():
    return document.read("robotic-park").cases()["event"]


def pair(**parts):
    """Two ground robots that listen to each other, and want to be 0.5 m apart; `parts` changes that."""
    given = {
        "title": "A pair",
        "duration_s": 60.0,
        "robots": {"A": Robot(kind="khepera4", start=[-0.4, 0.0]), "B": Robot(kind="khepera4", start=[0.4, 0.1])},
        "formation": Formation(links={"A - B": 0.5}),
        "trigger": PERIODIC,
        **parts,
    }
    return document.Experiment(**given)


# ---------------------------------------------------------------- a robot is a swarm of one


def eventful(experiment, groups):
    """A short run with everything that may happen; the same whoever shares a process with whom."""
    swarm = Swarm(experiment, groups).running()
    swarm.run(1.5)
    for agent, links in swarm.speaker_links("CF03"):  # its token is gone, then back
        agent.lose(links, swarm.t)
    group, row = swarm.where["KH02"]
    assert group.agent.hold(row) == ""
    swarm.run(1.53)
    for agent, links in swarm.speaker_links("CF03"):
        agent.find(links)
    assert group.agent.start(row, 0.0) == ""
    swarm.run(0.5)
    group, row = swarm.where["CF02"]
    group.agent.life.land(row, "told to")
    swarm.run(0.5)
    swarm.until(DONE)
    return swarm


@pytest.mark.slow
def test_seven_processes_of_one_are_one_of_seven_to_the_last_bit(park):
    assert_the_same(
        park, [[name] for name in park.robots], [["CF03", "TB01", "KH02"], ["KH01", "CF01"], ["CF02", "KH03"]]
    )


WAYS = {
    "periodic": ("periodic", None, {"kind": "periodic", "period_s": 0.3}),
    "send-on-delta": ({"kind": "send-on-delta", "smoothing_s": 0.3}, None, "send-on-delta"),
    "relative": ({"kind": "relative", "minimum_interval_s": 0.06}, "constant-velocity", "relative"),
    "mixed": ({"kind": "mixed", "evaluate_every_s": 0.06}, None, {"kind": "mixed", "maximum_silence_s": 0.5}),
    "decaying": ("decaying", {"kind": "constant-velocity", "horizon_s": 0.5}, "decaying"),
    "dynamic": ({"kind": "dynamic", "smoothing_s": 0.2}, "constant-velocity", "dynamic"),
    "integral": ({"kind": "integral", "evaluate_every_s": 0.1, "smoothing_s": 0.2}, None, "integral"),
    "predictive": ({"kind": "predictive", "smoothing_s": 0.4}, None, "relative-control"),
    "self-triggered": ("self-triggered", None, "self-triggered"),
    "self-triggered ahead": ("self-triggered", {"kind": "constant-velocity", "horizon_s": 0.3}, "lyapunov"),
    "lyapunov": ({"kind": "lyapunov", "maximum_silence_s": 0.7}, "constant-velocity", None),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_so_they_are_with_every_trigger_predictor_and_smoothing(park, way):
    trigger, prediction, update = WAYS[way]
    formation = msgspec.structs.replace(park.formation, update=update)
    experiment = changed(park, trigger=trigger, prediction=prediction, formation=formation)
    groups = [["TB01"], ["CF03", "KH02"], ["KH01", "CF01"], ["CF02"], ["KH03"]]
    together = assert_the_same(experiment, groups, least=50)
    decisions = together.agent("KH01").decisions
    assert decisions > 40
    updates = np.array([group.agent.updates[row] for group, row in together.where.values()])
    assert updates[0] == decisions  # a leader has no law to compute
    assert (updates > 1).all()
    assert update is None or updates.sum() < 0.98 * updates.max() * len(updates), updates


def assert_the_same(park, *grouped, least=300):
    """However they are grouped; gives the run of all in one process."""
    line = {"kind": "line", "move_by": [0.3, 0.1], "speed": 0.15}
    experiment = changed(park, duration_s=5.0, timeline=[Leg(at_s=2.0, robot="TB01", plan=line)], disturbance=NOISY)
    together = eventful(experiment, [tuple(experiment.robots)])
    for groups in grouped:
        apart = eventful(experiment, groups)
        assert apart.sent == together.sent
        assert apart.start_at == together.start_at
        for what in ("phase", "goal", "error", "setpoint", "position", "truth"):
            np.testing.assert_array_equal(apart.column(what), together.column(what), err_msg=what)
        for name in experiment.robots:
            (one, i), (other, j) = apart.where[name], together.where[name]
            assert one.agent.updates[i] == other.agent.updates[j]
    assert len(together.sent) > least
    assert together.log[-1]["phase"].tolist() == [DONE] * 7
    return together


# ---------------------------------------------------------------- what was heard


def bare(**parts):
    """The decision of A alone, ready to be told things; B is on link 0."""
    experiment = pair(**parts)
    return Agent(assign.assign(experiment, ["A"]))


def say(agent, position, stamp, at=0):
    agent.hear(np.array([at]), np.array([position]), np.zeros((1, 3)), np.array([stamp]), np.array([stamp + 0.01]))


def test_older_samples_than_known_are_left_out():
    agent = bare()
    say(agent, [1.0, 0.0, 0.0], 2.0)
    say(agent, [9.0, 9.0, 9.0], 1.0)
    say(agent, [9.0, 9.0, 9.0], 2.0)
    np.testing.assert_array_equal(agent.heard.position, [[1.0, 0.0, 0.0]])
    assert agent.heard.stamp[0] == 2.0
    say(agent, [0.5, 0.0, 0.0], 2.5)
    np.testing.assert_array_equal(agent.heard.position, [[0.5, 0.0, 0.0]])


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 2, 1]])
def test_of_samples_that_arrive_together_the_newest_stays(order):
    stamps, places = np.array([1.0, 2.0, 3.0])[order], np.array([[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])[order]
    together, one_by_one = bare(), bare()
    together.hear(np.zeros(3, dtype=np.intp), places, np.zeros((3, 3)), stamps, np.full(3, 4.0))
    for place, stamp in zip(places.tolist(), stamps.tolist(), strict=True):
        say(one_by_one, place, stamp)
    for agent in (together, one_by_one):
        np.testing.assert_array_equal(agent.heard.position, [[3.0, 0.0, 0.0]])
        assert agent.heard.stamp[0] == 3.0


def test_nothing_heard_is_nothing():
    heard = Heard.nothing(2)
    assert np.isnan(heard.position).all()
    assert (heard.stamp == -np.inf).all()
    assert (heard.gone == np.inf).all()
    heard.stamp[0] = 1.0
    assert heard.arrived[0] == -np.inf


def seen(t, position=(-0.4, 0.0, 0.0), **parts):
    """A measurement of A, now."""
    state = {
        "time": np.array([t]), "position": np.array([position], dtype=float), "velocity": np.zeros((1, 3)),
        "yaw": np.zeros(1), "true_position": np.zeros((1, 3)), "true_yaw": np.zeros(1), "battery": np.ones(1),
        "flying": np.zeros(1, dtype=bool),
    }  # fmt: skip
    return BodyState(**{**state, **{name: np.array([value]) for name, value in parts.items()}})


def test_who_misses_a_neighbour_is_not_ready_and_says_whom():
    agent = bare()
    agent.step(0.0, seen(0.0))
    assert (agent.life.phase[0], agent.life.reason[0]) == (IDLE, "never heard B")
    assert agent.missing(0) == ["B"]
    agent.step(0.01, seen(0.01, position=(np.nan, 0, 0)))
    assert agent.life.reason[0] == "no position of its own"
    agent.step(0.7, seen(0.1))
    assert agent.life.reason[0] == "no position of its own"  # too old
    say(agent, [0.4, 0.1, 0.0], 0.7)
    agent.step(0.71, seen(0.71))
    assert (agent.life.phase[0], agent.life.reason[0]) == (READY, "")
    assert agent.missing(0) == []
    agent.lose(np.array([0]), 0.8)
    assert agent.missing(0) == ["B"]


def test_patience_ends():
    agent = bare(start=Start(deadline_s=2.0, missing="go-on"))
    agent.step(2.0, seen(2.0))
    assert agent.life.phase[0] == IDLE
    agent.step(2.01, seen(2.01))
    assert agent.life.phase[0] == READY


def test_a_position_that_is_not_known_is_not_told():
    agent = bare()
    assert not len(agent.step(0.0, seen(0.0, position=(np.nan, 0, 0))).speak)
    assert np.isinf(agent.told.position).all()
    assert len(agent.step(0.02, seen(0.02)).speak) == 0  # asked on every second tick
    assert agent.step(0.03, seen(0.03)).speak.tolist() == [0]


# ---------------------------------------------------------------- neighbours that go and come back


def triangle(**parts):
    """Three ground robots; C listens to nobody and stands."""
    robots = {
        name: Robot(kind="khepera4", start=start)
        for name, start in {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [0.0, -0.5]}.items()
    }
    links = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}
    return pair(robots=robots, formation=Formation(links=links), **parts)


def live(agent):
    """The links that take part in the decision."""
    return agent.hearing.live.tolist()


def test_a_neighbour_that_is_gone_is_left_out_after_the_silence_and_back_when_found():
    swarm = Swarm(triangle(), [["A"], ["B"], ["C"]]).running().run(0.5)
    agent = swarm.agent("A")
    assert live(agent) == [0, 1]
    begin = swarm.t
    agent.lose(np.array([0]), begin)
    swarm.groups[0].by_speaker.pop("B")  # and A hears nothing of it any more
    swarm.run(1.0)
    assert live(agent) == [0, 1]
    swarm.run(0.02)
    assert live(agent) == [1]
    assert agent.missing(0) == ["B"]
    before = swarm.row("A", "goal")
    swarm.run(0.1)
    assert not np.array_equal(swarm.row("A", "goal"), before)  # it still follows C
    agent.find(np.array([0]))
    swarm.step()
    assert live(agent) == [0, 1]


def test_a_neighbour_is_back_when_it_is_heard_again():
    swarm = Swarm(triangle(), [["A"], ["B"], ["C"]]).running().run(0.5)
    agent = swarm.agent("A")
    agent.lose(np.array([0]), swarm.t - 5.0)
    swarm._flying.clear()
    swarm.step()
    assert live(agent) == [1]
    swarm.run(0.03)
    assert live(agent) == [0, 1]


def test_a_neighbour_never_heard_does_not_hide_one_that_is_gone():
    experiment = triangle(start=Start(deadline_s=0.1, missing="go-on"))
    agent = Agent(assign.assign(experiment, ["A"]))
    say(agent, [0.0, -0.5, 0.0], 0.1, at=1)  # C is heard, B never
    for tick in range(30):
        agent.step(0.01 * tick, seen(0.01 * tick))
    assert agent.life.takeoff(0) == ""
    agent.step(0.3, seen(0.3))
    agent.step(0.31, seen(0.31))
    assert agent.start(0, 0.32) == ""
    agent.step(0.32, seen(0.32))
    assert live(agent) == [1]
    agent.lose(np.array([1]), 0.33)
    for tick in range(33, 200):
        agent.step(0.01 * tick, seen(0.01 * tick))
    assert live(agent) == []
    np.testing.assert_array_equal(agent.goal, [[-0.4, 0.0, 0.0]])  # alone: it holds


def test_who_is_alone_holds_where_it_was_then():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    moving = swarm.row("A", "goal")
    agent = swarm.agent("A")
    agent.lose(np.array([0]), swarm.t)
    swarm.groups[0].by_speaker.clear()
    swarm.run(1.2)
    held = swarm.row("A", "goal")
    assert not np.array_equal(held, moving)
    swarm.run(1.0)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    assert np.linalg.norm(swarm.row("A", "truth") - held) < 0.02
    agent.find(np.array([0]))
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)


def test_who_is_cut_off_holds_and_goes_on():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    agent = swarm.agent("A")
    agent.outside.offline_since = swarm.t
    swarm.run(1.0)
    busy = swarm.row("A", "goal")
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    assert not np.array_equal(held, busy)
    swarm.run(0.5)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    agent.outside.offline_since = np.inf
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)


def test_hold_and_start_again():
    swarm = Swarm(pair(), [["A"], ["B"]])
    agent = swarm.agent("A")
    swarm.step()
    assert agent.hold(0) == "cannot hold while idle"
    swarm.running().run(0.3)
    assert agent.hold(0) == ""
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    swarm.run(0.5)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    assert swarm.phase("A") == RUNNING
    assert agent.start(0, 0.0) == ""
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)
    assert agent.life.start_at[0] == swarm.start_at


def test_another_row_that_arrives_in_the_air_does_not_move_a_place_that_is_held():
    robots = {
        "A": Robot(kind="khepera4", start=[-0.4, 0.0]),
        "B": Robot(kind="khepera4", start=[0.4, 0.1]),
        "F": Robot(kind="crazyflie", start=[0.0, 0.6], hover=0.5),
    }
    swarm = Swarm(pair(robots=robots))
    agent = swarm.agent("A")
    swarm.run(0.05)
    for row in range(3):
        assert agent.life.takeoff(row) == ""
    swarm.run(0.05)
    for row in range(2):
        assert agent.start(row, swarm.t) == ""
    swarm.run(0.2)
    assert agent.hold(0) == ""
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    while swarm.phase("F") < AIRBORNE:
        swarm.step()
        np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    swarm.run(0.3)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    np.testing.assert_allclose(swarm.row("F", "goal"), [0.0, 0.6, 0.5], atol=1e-9)


# ---------------------------------------------------------------- formations, leaders, plans


def test_a_pair_comes_to_the_distance_wanted():
    swarm = Swarm(pair()).running().run(25.0)
    a, b = swarm.log[-1]["truth"]
    assert np.linalg.norm(a - b) == pytest.approx(0.5, abs=0.012)  # both stand within 5 mm of their goals
    np.testing.assert_allclose(swarm.log[-1]["error"], abs(np.linalg.norm(a - b) - 0.5), atol=1e-9)
    assert swarm.agent("A").decisions == 251  # at 0 and at 25 s


def test_decisions_and_questions_keep_to_their_rates():
    swarm = Swarm(pair()).running()
    begin = swarm.tick
    swarm.run(2.0)
    goals = swarm.column("goal")[begin - 1 :, 0]
    changes = np.flatnonzero((np.diff(goals, axis=0) != 0).any(axis=1)) + 1
    np.testing.assert_array_equal(changes % 10, 0)
    asked = [tick - begin + 1 for tick, name in swarm.sent if tick >= begin and name == "A"]
    np.testing.assert_array_equal(asked, np.arange(2, 201, 2))


def test_steps_of_the_goal_are_clamped():
    swarm = Swarm(pair(formation=Formation(links={"A - B": 0.5}, gain=50.0, clamp=0.07))).running().run(0.05)
    step = swarm.row("A", "goal") - swarm.log[-5]["position"][0]
    assert step[0] == pytest.approx(0.07, abs=0.01)
    assert np.abs(step).max() < 0.075


@pytest.mark.parametrize("kind", ["khepera4", "crazyflie", "tello"])
def test_a_leader_follows_its_plan(kind):
    hover = None if kind == "khepera4" else 0.6
    robots = {"L": Robot(kind=kind, start=[0.0, 0.0], hover=hover), "F": Robot(kind="khepera4", start=[-0.5, 0.0])}
    plan = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.1}
    experiment = pair(
        robots=robots, formation=Formation(links={"L > F": 0.8}), timeline=[Leg(at_s=1.0, robot="L", plan=plan)]
    )
    swarm = Swarm(experiment, [["L"], ["F"]]).running()
    height = hover or 0.0
    begin = swarm.row("L", "goal")
    np.testing.assert_allclose(begin, [0.0, 0.0, height], atol=1e-9)
    swarm.run(1.0)
    np.testing.assert_allclose(swarm.row("L", "goal"), begin, atol=1e-9)
    swarm.run(2.0)
    np.testing.assert_allclose(swarm.row("L", "goal") - begin, [0.2, 0.0, 0.0], atol=0.0101)
    swarm.run(6.0)
    np.testing.assert_allclose(swarm.row("L", "goal") - begin, [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(swarm.row("L", "truth"), begin + np.array([0.3, 0.0, 0.0]), atol=0.006)


def test_a_follower_with_a_plan_is_pulled_by_both():
    robots = {"L": Robot(kind="khepera4", start=[0.0, 0.0]), "F": Robot(kind="khepera4", start=[-0.5, 0.0])}
    plan = {"kind": "hold", "at": [0.0, 0.5]}
    formation = Formation(links={"L > F": 0.5}, tracking_gain=3.0)
    experiment = pair(robots=robots, formation=formation, timeline=[Leg(at_s=0.0, robot="F", plan=plan)])
    swarm = Swarm(experiment).running().run(40.0)
    place = swarm.row("F", "truth")
    assert np.linalg.norm(place - [0.0, 0.5, 0.0]) < 0.2  # the pull ends with the third power of what is left
    assert np.linalg.norm(place) == pytest.approx(0.5, abs=0.02)


def test_whoever_has_neither_neighbours_nor_a_plan_stays():
    swarm = Swarm(triangle()).running().run(5.0)
    np.testing.assert_allclose(swarm.row("C", "truth"), [0.0, -0.5, 0.0], atol=1e-9)


def test_who_joins_late_is_where_the_plan_is_now():
    plan = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.1}
    robots = {"L": Robot(kind="khepera4", start=[0.0, 0.0])}
    swarm = Swarm(pair(robots=robots, formation=Formation(), timeline=[Leg(at_s=1.0, robot="L", plan=plan)]))
    swarm.run(0.05)
    agent = swarm.agent("L")
    agent.life.takeoff(0)
    swarm.run(0.05)
    begin = swarm.t - 3.0
    assert agent.start(0, begin) == ""
    swarm.step()
    assert swarm.phase("L") == RUNNING
    assert agent.tick == 301
    np.testing.assert_allclose(swarm.row("L", "goal"), [0.2, 0.0, 0.0], atol=1e-9)
    assert agent.decisions == 1


# ---------------------------------------------------------------- when things go wrong


def drone(**parts):
    """One Crazyflie that stands in the air."""
    robots = {"F": Robot(kind="crazyflie", start=[0.1, 0.2], hover=0.5)}
    return Swarm(pair(robots=robots, formation=Formation(), **parts))


def blinded(swarm, what, value):
    """From now on its position is lost, or elsewhere."""
    (group,) = swarm.groups

    def spoil(t, state):
        if what == "old":
            state.time[:] = value
        else:
            state.position[:] = value
        return state

    group.spoil = spoil


@pytest.mark.parametrize(("what", "grace"), [("old", 81), ("nowhere", 31)])  # 0.3 s of holding
@pytest.mark.parametrize("moment", ["climbing", "waiting", "running"])
def test_a_drone_that_does_not_know_where_it_is_lands(what, grace, moment):
    swarm = drone()
    if moment == "running":
        swarm.running().run(0.5)
    elif moment == "waiting":
        swarm.until(AIRBORNE)
    else:
        swarm.run(0.02)
        swarm.agent("F").life.takeoff(0)
        swarm.run(0.8)
        assert swarm.phase("F") == READY
    (group,) = swarm.groups
    blinded(swarm, what, swarm.t - 1e-9 if what == "old" else np.nan)  # 0.5 s are allowed
    for _ in range(grace):
        assert swarm.phase("F") < LANDING
        swarm.step()
    assert swarm.phase("F") == LANDING
    assert group.agent.life.reason == ["its own position is lost"]
    assert np.isnan(swarm.row("F", "setpoint")).all()
    for _ in range(500):
        swarm.step()
    assert swarm.phase("F") == DONE
    assert swarm.row("F", "truth")[2] == 0.0


@pytest.mark.parametrize("moment", ["climbing", "running"])
def test_a_drone_that_left_the_arena_lands(moment):
    swarm = drone()
    if moment == "running":
        swarm.running()
    else:
        swarm.run(0.02)
        swarm.agent("F").life.takeoff(0)
        swarm.run(0.5)
    blinded(swarm, "elsewhere", [2.2, 0.0, 0.5])  # the arena ends at 2 m
    swarm.run(0.1)
    assert swarm.phase("F") < LANDING
    blinded(swarm, "elsewhere", [2.3, 0.0, 0.5])
    swarm.step()
    assert (swarm.phase("F"), swarm.agent("F").life.reason) == (LANDING, ["it left the arena"])


def test_a_drone_whose_motors_stop_by_themselves_is_not_commanded_any_more():
    swarm = drone()
    swarm.running().run(0.2)
    (group,) = swarm.groups

    def down(t, state):
        state.flying = np.zeros_like(state.flying)
        return state

    group.spoil = down
    swarm.step()
    assert (swarm.phase("F"), group.agent.life.reason) == (LANDING, ["it came down by itself"])
    swarm.step()  # the body is told to land, all the same
    assert np.isnan(swarm.row("F", "setpoint")).all()
    swarm.step()
    assert swarm.phase("F") == DONE


def test_a_ground_robot_that_does_not_know_where_it_is_stops_and_goes_on():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    group, _ = swarm.where["A"]

    def blind(t, state):
        state.position[:] = np.nan
        return state

    group.spoil = blind
    swarm.run(1.0)
    assert swarm.phase("A") == RUNNING
    np.testing.assert_array_equal(swarm.row("A", "setpoint"), np.zeros(4))
    del group.spoil
    swarm.run(0.3)
    assert swarm.row("A", "setpoint").any()


def test_a_ground_robot_outside_the_arena_rolls_out():
    swarm = Swarm(pair()).running()
    (group,) = swarm.groups

    def far(t, state):
        state.position[0] = [9.0, 0.0, 0.0]
        return state

    group.spoil = far
    swarm.run(0.5)
    assert [swarm.phase(name) for name in "AB"] == [DONE, RUNNING]
    assert group.agent.life.reason[0] == "it left the arena"


def test_bodies_act_by_themselves_until_they_are_in_the_air_and_from_landing_on():
    swarm = drone(duration_s=1.0).until(DONE)
    phase, setpoint = swarm.column("phase")[:, 0], swarm.column("setpoint")[:, 0]
    passive = (phase < AIRBORNE) | (phase > RUNNING)
    assert np.isnan(setpoint[passive]).all()
    assert np.isfinite(setpoint[~passive]).all()
    assert set(phase.tolist()) == {int(p) for p in Phase if p != IDLE}
    assert swarm.row("F", "truth")[2] == 0.0


def test_a_ground_robot_that_is_not_running_stands():
    swarm = Swarm(pair(duration_s=1.0)).until(DONE)
    phase, setpoint = swarm.column("phase"), swarm.column("setpoint")
    assert not setpoint[(phase < AIRBORNE) | (phase > RUNNING)].any()
    assert setpoint[phase == RUNNING].any()
