"""Environments of learning: PettingZoo's and Gymnasium's checkers, episodes that are flights, and bad input."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="environments are the extra [learn]: ./zenpark install pettingzoo gymnasium")

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from agents.errors import ExplainedError
from agents.plugins.law import Control, Law
from agents.plugins.laws import Gradient
from experiments.catalogue import index
from experiments.file import document
from experiments.learning import actions
from experiments.learning.actions import LearningError, Voice
from experiments.learning.environment import Environment
from experiments.learning.vector import Environments, SingleAgent
from experiments.virtual_time import stretch
from experiments.virtual_time.simulation import VirtualRun
from tests.experiments.virtual_time.evaluators import alike


def distributed_case(name):
    """First case of a file in which the robots decide for themselves; None without one."""
    return next((case for case, plan in document.read(name).cases().items() if not plan.guided), None)


FILES = [(name, case) for name in index.names() if (case := distributed_case(name))]
LONGER = (("robotic-park", 2.0), ("flocking", 1.5))


def load(name, *overrides, duration_s=0.5):
    return document.load(name, f"duration_s={duration_s}", *overrides)


def fly(made, seed, act):
    """True positions (K, N, 3) after each decision of an episode, and the sum of all rewards."""
    made.reset(seed=seed)
    places, total = [], 0.0
    while made.agents:
        _, rewards, *_ = made.step({name: act(name, made.view(name)) for name in made.agents})
        total += sum(rewards.values())
        places.append([state.true_position for state in made.flight.snapshot(0.0).states])
    return np.array(places), total


def flown(log, count, hz=10.0):
    """True positions (K, N, 3) of a flight after each decision."""
    return log.true_position[[int(np.argmin(abs(log.time - (k + 1) / hz))) for k in range(count)]]


HEAVY = {"crowd", "endurance", "mixed-reality", "mpc", "obstacle-course"}  # many robots, or dear ones
CHECKED = [pytest.param(*each, marks=[pytest.mark.nightly] if each[0] in HEAVY else []) for each in FILES]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "case"), CHECKED)
def test_checkers_of_pettingzoo_pass(name, case):
    given = document.read(name)
    starts = 1 if given.cases()[case].engine_name == "point-mass" else None

    def made():
        return Environment(given, case, talk=True, observes="time target", observes_each="place age", starts=starts)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(made(), num_cycles=5)
        parallel_seed_test(made, num_cycles=5)


class Pursuit(Law, frozen=True):
    """The law of a file that is a gradient, as goals."""

    inner: Law

    def step(self, view, memory):
        x, y, _ = view.position
        pulls = [
            self.inner.pull(tuple(a - b for a, b in zip(view.position, each.position, strict=True)), each.link)
            for each in view.neighbours
        ]
        return Control(goal=(x + sum(u for u, _, _ in pulls), y + sum(v for _, v, _ in pulls), math.nan))


def acting(made, law):
    """Actions of a law, which remembers."""
    memories = {}

    def act(name, view):
        memory = memories.setdefault(name, dict(law.begin(view.robot)))
        control = law.step(view, memory)
        memories[name] = dict(control.memory)
        if control.velocity is not None:
            return control.velocity[:2]
        return control.goal[0] - view.position[0], control.goal[1] - view.position[1]

    return act


@pytest.mark.parametrize(
    ("name", "seconds"), [("policy", 1.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in LONGER)]
)
def test_episodes_are_flights(name, seconds):
    given = load(name, "timeline=[]", duration_s=seconds)
    for case, plan in given.cases().items():
        gradient = isinstance(plan.law, Gradient)
        law = Pursuit(plan.law) if gradient else plan.law
        made = Environment(given, case, action="goal" if gradient else "velocity")
        places, _ = fly(made, 7, acting(made, law))
        moved = {each: replace(plan.assignment(each), law=law) for each in made.possible_agents} if gradient else {}
        flight = VirtualRun(plan, 7, assignments=moved)
        flight.fly(landing=False)
        assert len(places) == round(10 * seconds)
        assert np.array_equal(places, flown(flight.log(), len(places)))


def episodes(made, *, compiled, count=45):
    """Everything that two episodes show, with a state that is kept in the second one, and the ticks that were compiled.

    Robots go their own ways, some of them into others.
    """
    shown, ticks, rng, state = [], 0, np.random.default_rng(4), b""
    for seed in (3, 4):
        stretch.WORK[:] = 1e6 if compiled else -1e6, 0.0
        made.reset(seed=seed)
        for k in range(count):
            if not made.agents:
                break
            results = made.step({name: rng.uniform(-0.4, 0.4, 3) for name in made.agents})
            shown.append([{name: np.array(each) for name, each in part.items()} for part in results[:4]])
            shown[-1].append({name: each["messages"] for name, each in results[4].items()})
            if seed == 4 and k == 25:
                state = made.save()
            if seed == 4 and k == 35:
                made.reset(options={"state": state})
        flown = made.flight.stretches
        assert compiled or flown is None
        ticks += 0 if flown is None else flown.flown + flown.open * (flown.tick - flown._begun)
    stretch.WORK[:] = 0.0, 0.0
    return shown, ticks


def neighbour_errors(snapshot, row):
    """A reward by what a robot believes, and of what only all of its state shows."""
    robot = snapshot.robots[row]
    return sum(each.position[0] + each.stamp for each in robot.neighbours.all) + robot.setpoint[0] + robot.decisions


CASES = {
    "event-loss": ("policy", "event-loss", {}),
    "goals": ("policy", "event", {"action": "goal", "starts": 1}),
    "some agents": ("policy", "periodic", {"agents": ("CF01", "CF03"), "reward": neighbour_errors}),
    "wheels": ("triangle", "event", {"message_price": 0.1}),
    "plans": ("convoy", "event", {"observes": "time target position", "reward": neighbour_errors}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "case", "options"), CASES.values(), ids=CASES)
def test_compiled_episodes_are_plain_ones(name, case, options):
    made = Environment(document.read(name), case, talk=True, **options)
    (plain, _), (compiled, ticks) = (episodes(made, compiled=compiled) for compiled in (False, True))
    assert alike(tuple(map(tuple, plain)), tuple(map(tuple, compiled)))
    assert ticks > 500


class Growing(Voice, frozen=True, kw_only=True):
    """A trigger with whole numbers beyond those of C, once the run has lasted."""

    def fires(self, view):
        return view.since_event > 0.2 or (view.since_start > 1.2 and (1 << 60) * 4 > 7)


@pytest.mark.slow
def test_episodes_outlast_errors_of_compiled_ticks(monkeypatch):
    monkeypatch.setattr(actions, "Voice", Growing)
    made = Environment(load("policy", duration_s=3.0), "event-loss", talk=True)
    (plain, _), (compiled, ticks) = (episodes(made, compiled=compiled, count=28) for compiled in (False, True))
    assert ticks > 150
    assert alike(tuple(map(tuple, plain)), tuple(map(tuple, compiled)))


def test_bad_input_names_place_and_remedy():
    given, central = load("triangle"), document.read("architectures")
    faults = {
        "no case 'evnt' in this experiment\n  did you mean 'event'": lambda: Environment(given, "evnt"),
        "triangle.toml: no agent 'KH3'; .*KH0": lambda: Environment(given, agents=["KH3"]),
        "no action 'force'; known: velocity, goal": lambda: Environment(given, action="force"),
        "cannot observe 'velocty'; known: position, velocity, .*": lambda: Environment(given, observes="velocty"),
        "a central controller decides .*; take a case without one": lambda: Environment(central, "centralised"),
    }
    for fault, made in faults.items():
        with pytest.raises(ExplainedError, match=fault):
            made()


def test_bad_actions_are_refused_before_they_fly():
    made = Environment(load("triangle"), talk=True)
    made.reset()
    good = {name: np.zeros(3) for name in made.agents}
    faults = {
        "that of CF01 has the shape \\(2,\\); give 3 numbers: x, y, whether to transmit": good | {"CF01": np.zeros(2)},
        "that of CF01 is .*nan.*, not finite; look for NaN": good | {"CF01": [0.0, math.nan, 0.0]},
        "no agent 'CF1' flies now; did you mean 'CF01'": good | {"CF1": np.zeros(3)},
        "there is none for KH01; give one for each of `env.agents`": {"CF01": np.zeros(3)},
    }
    for fault, wrong in faults.items():
        with pytest.raises(LearningError, match=fault):
            made.step(wrong)


def test_states_go_on_to_the_last_bit():
    made = Environment(load("policy"), "event-loss", starts=2)

    def still(_name, _view):
        return 0.1, -0.05

    first, other, again = fly(made, 3, still), fly(made, None, still), fly(made, 3, still)
    assert np.array_equal(first[0], again[0])
    assert not np.array_equal(first[0], other[0])
    assert made.reset()[1]["CF01"]["seed"] == 4  # in turn with 3


@pytest.mark.parametrize("given", [None, "good", math.nan, np.ones(3)])
def test_a_reward_is_a_finite_number(given):
    made = Environment(load("triangle", duration_s=9.0), reward=lambda *_: given)
    made.reset(1)
    with pytest.raises(LearningError, match=r"KH01: the reward at 0\.\d* s is .*; return a finite number"):
        made.step({name: np.zeros(2, dtype=np.float32) for name in made.agents})


def test_robots_that_touch_end_early():
    made = Environment(load("triangle", duration_s=9.0), penalty=7.0, message_price=0.5, reward=lambda *_: 1.0)
    made.reset()
    ends = {}
    while len(made.agents) == 3:
        actions = dict.fromkeys(made.agents, (0.0, 0.0))
        (x, y, _), (other,) = made.view("KH01").position, [e for e in made.view("KH01").neighbours if e.name == "KH02"]
        actions["KH01"] = other.position[0] - x, other.position[1] - y
        _, rewards, ends, truncated, infos = made.step(actions)
        for name, info in infos.items():
            assert rewards[name] == 1.0 - 0.5 * info["messages"] - 7.0 * ends[name]
    assert ends == {"KH01": True, "KH02": True, "CF01": False}
    assert not any(truncated.values())
    assert made.agents == ["CF01"]


def test_wrappers_draw_from_the_seed_of_an_episode():
    made = Environment(load("policy"))
    drawn = [(made.reset(seed=seed), made.unwrapped.np_random.integers(100, size=5).tolist())[1] for seed in (2, 3, 2)]
    assert drawn[0] == drawn[2] != drawn[1]


def test_talk_is_what_the_agent_says():
    made = Environment(load("policy", duration_s=2.0), "event", talk=True)
    made.reset(seed=1)
    sent = []
    for k in range(10):
        infos = made.step(dict.fromkeys(made.agents, (0.1, 0.0, 1.0 if k == 4 else -1.0)))[4]
        sent.append(sum(each["messages"] for each in infos.values()))
    assert sent[1:4] + sent[5:9] == [0] * 7  # before the longest silence is over
    assert sent[4] == 4


def test_one_agent_is_an_environment_of_gymnasium():
    alone = SingleAgent(Environment(load("policy"), agents=["CF02"], starts=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on infinite bounds, which places have
        check_env(alone, skip_render_check=True)
    with pytest.raises(LearningError, match="has one agent, not CF01, CF02"):
        SingleAgent(Environment(load("policy")))


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_vectors_are_their_environments(processes):
    single = Environment(load("policy"), "event")
    vector = Environments(single, 3, processes=processes)
    try:
        seen, _ = vector.reset(seed=5)
        expected = np.array([[*single.reset(seed=seed)[0].values()] for seed in (5, 10_005, 20_005)])
        assert np.array_equal(seen, expected.reshape(12, -1))
        for _ in range(5):
            seen, _, ended, truncated, infos = vector.step(np.tile([0.1, 0.0], (12, 1)))
        assert not ended.any()
        assert truncated.all()
        assert infos["_final_obs"].all()
        assert np.array_equal(seen[:4], np.array([*single.reset(seed=6)[0].values()]))
        with pytest.raises(LearningError, match="not finite"):
            vector.step(np.full((12, 2), math.nan))
    finally:
        vector.close()


@pytest.mark.slow
def test_compiled_flights_begin_again_in_their_records(monkeypatch):
    monkeypatch.setattr(stretch, "OFTEN_S", 0.13)  # the machine's compiler takes over on the way
    made = Environment(document.read("policy"), "event-loss", starts=1, observes="time velocity", observes_each="age")
    shown, flights = [], set()
    for turn in range(8):
        stretch.WORK[:] = 1e6 if turn else -1e6, 0.0
        observations, _ = made.reset(seed=3)
        steps = [observations.values()]
        for k in range(30):
            found = made.step({name: (0.3 * math.sin(k), 0.1) for name in made.agents})
            steps += [each.values() for each in found[:2]]
        shown.append([[np.array(each).tolist() for each in step] for step in steps])
        flights.add(id(made.flight))
    assert all(each == shown[0] for each in shown)
    assert len(flights) < 8
    assert made.flight.stretches._prepared.driver.often
    stretch.WORK[:] = 0.0, 0.0


@pytest.mark.slow
def test_vectors_are_compiled_environments():
    def turns():
        vector = Environments(Environment(load("policy", duration_s=1.0), "event", starts=2), 3, processes=1)
        seen, _ = vector.reset(seed=5)
        results, rng = [seen], np.random.default_rng(2)
        for _ in range(35):
            results += vector.step(rng.uniform(-0.3, 0.3, (12, 2)))[:4]
        return results

    both = []
    for work in (-1e6, 1e6):
        stretch.WORK[:] = work, 0.0
        both.append(turns())
    stretch.WORK[:] = 0.0, 0.0
    assert all(np.array_equal(*pair) for pair in zip(*both, strict=True))
