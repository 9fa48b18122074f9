"""Every registered plug-in, a user's too: a robot decides the same alone and in company, and bears losses."""

import itertools
from base64 import b64encode
from dataclasses import replace
from functools import partial
from math import cos, isfinite, nan, pi, sin
from random import Random

import msgspec
import pytest

from agents.body.interface import RangeScan
from agents.body.kinds import KINDS
from agents.decision.lifecycle import RUNNING
from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_NOTHING, BY_RELATIVE
from agents.plugins import registry
from agents.plugins.laws import Gradient
from agents.plugins.planners import Leg
from agents.plugins.registry import AVOIDANCES, LAWS, PLANNERS, PREDICTORS, TRIGGERS
from agents.vectors import UNKNOWN, ZERO
from experiments.catalogue import index
from experiments.definition.plan import Plan
from experiments.file import document
from tests.agents.bench import Bench, near, own
from tests.agents.learned import learned
from tests.cases import mostly_slow
from tests.small import triangle

GROUPS = (LAWS, TRIGGERS, PREDICTORS, PLANNERS, AVOIDANCES)
EVERY = [(group, name) for group in GROUPS for name in registry.names(group)]
REMEMBERING = [name for name in registry.names(LAWS) if not issubclass(registry.struct(LAWS, name), Gradient)]
TALKING = {(LAWS, name) for name in REMEMBERING}
PLACES = {"A": (-0.4, 0.0, 0.0), "B": (0.4, 0.1, 0.0), "C": (0.0, -0.5, 0.0)}
WANTS = {"distance": BY_DISTANCE, "any": BY_DISTANCE, "relative": BY_RELATIVE, "bearing": BY_BEARING}
PATH = b64encode(b"t,x,y\n0,0,0\n2,0.3,0.2\n").decode()
SAMPLES = (0.3, [0.3, 0.2], [[0.3, 0.2], [-0.2, 0.4]])


def made(group, name):
    """A plug-in with its defaults; numbers and places stand for parameters without one."""
    kind = registry.struct(group, name)
    if group in (LAWS, TRIGGERS) and kind.LIBRARY:
        pytest.importorskip(kind.LIBRARY, reason=f"{name} needs {kind.LIBRARY}")
    if group == TRIGGERS and kind.FILES:
        return registry.build(group, {"kind": name, "model": learned(3, 1, bias=-0.1)})
    if group == LAWS and kind.FILES and name in index.names():
        return document.read(index.find_file(name), []).plan.law
    if group == PLANNERS and kind.FILES:
        return registry.build(group, {"kind": name, "file": "a.csv", "content": PATH})
    needed = [field.encode_name for field in msgspec.structs.fields(kind) if field.required]
    for first, other in itertools.product(({}, *SAMPLES), SAMPLES):
        try:
            parameters = dict.fromkeys(needed, other) | dict.fromkeys(needed[:1], first)
            return registry.build(group, {"kind": name, **parameters})
        except (msgspec.ValidationError, ValueError):
            continue
    pytest.skip(f"no sample fits the parameters of {name}")


def assignment(group, name):
    """A of three ground robots with this plug-in at work."""
    plan = Plan(triangle(avoidance={"kind": "potential", "hears": "all"}, prediction="constant-velocity"))
    given, plugin = replace(plan.assignment("A"), start=None, starts=()), made(group, name)
    if group == LAWS:
        wants = WANTS.get(plugin.NEEDS, BY_NOTHING)
        links = tuple(
            msgspec.structs.replace(link, relative=(0.3, 0.2, 0.0), bearing=(0.6, 0.8, nan), wants=wants)
            for link in given.neighbours
        )
        return replace(given, law=plugin, neighbours=links)
    if group == TRIGGERS:
        given = replace(given, trigger=plugin) if "communication" in plugin.PLACES else given
        return replace(given, update=plugin) if "control" in plugin.PLACES else given
    if group == PLANNERS:
        return replace(given, legs=(Leg(0.5, plugin),))
    return replace(given, **{"predictor" if group == PREDICTORS else "avoidance": plugin})


def hear(bench, order=1, *, silent=True):
    """Poses of neighbours that wander, each on its own period, in any order within a tick.

    Unless they are `silent`, they say variables that move by themselves.
    """
    for link, sender in list(enumerate(bench.neighbours.all))[::order]:
        if round(bench.t / 0.01) % (7 + 3 * link) == 0:
            (x, y, z), t = PLACES[sender.name], bench.t
            swing = 0.2 * ((t * (1 + link)) % 1.0 - 0.5)
            sizes = {} if silent else bench.robot.stepping.says
            said = {name: tuple(0.5 * swing + 0.1 * k for k in range(size)) for name, size in sizes.items()}
            velocity = (0.2 * (1 + link), -0.2, 0.0)
            bench.neighbours.receive(link, (x + swing, y - swing, z), velocity, t, t, yaw=0.3, said=said)


def follow_setpoint(bench):
    """Follow the last setpoint, as wheels do, and see a wall."""
    v, omega, *_ = bench.robot.setpoint
    x, y, z = bench.position
    if isfinite(v + x + bench.yaw):
        bench.position = (x + 0.01 * v * cos(bench.yaw), y + 0.01 * v * sin(bench.yaw), z)
        bench.yaw += 0.01 * omega
    if round(bench.t / 0.01) % 10 == 0:
        bench.values["scan"] = RangeScan(bench.t, (0.0, 1.0), (0.0, 0.0), (0.35, 0.5))


def tick(bench, order=1, *, silent=True):
    hear(bench, order, silent=silent)
    follow_setpoint(bench)


def lives(given, company):
    """Traces of a robot over 2 s, while `company` robots of the same plug-ins are asked in between."""
    trace, others = [], [Bench(given, (0.1 * k, -0.1 * k, 0.0)) for k in range(company)]

    def recorded(bench):
        tick(bench)
        trace.append(repr((bench.robot.goal, bench.robot.setpoint, bench.robot.error, bench.said[-1:])))

    first = Bench(given, PLACES["A"]).running(recorded)
    for other in others:
        other.life.phase, other.life.start_at = RUNNING, 0.0
    for _ in range(200):
        first.step(0.01, recorded)
        for other in others:
            other.step(0.01, tick)
    assert first.life.phase == RUNNING, first.life.reason
    return trace


@pytest.mark.parametrize(("group", "name"), mostly_slow(EVERY, 4))
def test_same_alone_and_in_company(group, name):
    given = assignment(group, name)
    assert lives(given, 0) == lives(given, 2)


def known(bench):
    memory = {} if bench.robot.stepping is None else bench.robot.stepping.memory
    return {name for name, values in memory.items() if all(map(isfinite, values))}


def started(group, name):
    """A robot that runs with a plug-in, and how it bears some time.

    Setpoints stay finite then, and what a law that remembers knew at first stays known.
    """
    bench, talking = Bench(assignment(group, name), PLACES["A"]), partial(tick, silent=(group, name) not in TALKING)
    bench.running(talking).step(0.5, talking)
    at_first = known(bench)

    def bear(seconds, every_tick=talking):
        def watched(bench):
            every_tick(bench)
            assert all(map(isfinite, bench.robot.setpoint))

        bench.step(seconds, watched)
        assert at_first <= known(bench)

    return bench, bear


@pytest.mark.parametrize(("group", "name"), mostly_slow(EVERY, 4))
def test_losses_and_restarts_are_borne(group, name):
    bench, bear = started(group, name)
    for link, every_tick in ((0, tick), (1, follow_setpoint)):  # one, then all
        bench.neighbours.mark_lost(link, bench.t)
        bear(1.5, every_tick)
    for link in (0, 1):
        bench.neighbours.mark_alive(link)
        bear(0.5)
    bench.neighbours.discard_pose(1)  # a new process, without a pose at first
    bear(0.3, follow_setpoint)
    bear(0.3, tick)  # poses without words
    for number, age in ((nan, 0.0), (9.0, 1.0)):  # unknown words, and late ones, which are left out
        says = bench.robot.stepping.says if (group, name) in TALKING else {}
        said = {each: (number,) * size for each, size in says.items()}
        bench.neighbours.receive(0, (0.5, 0.5, 0.0), ZERO, bench.t - age, bench.t, yaw=nan, said=said)
        assert not any(9.0 in each for each in bench.neighbours.all[0].said.values())
        bear(0.3, follow_setpoint)


@pytest.mark.parametrize(("group", "name"), mostly_slow(EVERY, 4))
def test_unknown_positions_and_velocities_are_borne(group, name):
    bench, bear = started(group, name)
    place = bench.position
    for unknown in (UNKNOWN, (nan, 0.0, 0.0)):
        bench.position = unknown
        bear(0.2)
        assert bench.robot.setpoint == (0.0, 0.0, 0.0, 0.0)
        bench.position = place
        bear(0.2)
    for velocity in (UNKNOWN, (1e9, -1e9, 0.0)):
        bench.velocity = velocity
        bear(0.2)
    bench.velocity, bench.yaw = ZERO, nan
    bear(0.2)
    for link in (0, 1):
        bench.hear(link, place)  # in its own place
    bear(0.3)


@pytest.mark.parametrize("name", REMEMBERING)
def test_laws_that_remember_bear_any_order_and_period(name):
    given, ends = assignment(LAWS, name), []
    for order, slower in ((1, 1), (-1, 1), (1, 3)):
        said = partial(tick, order=order, silent=False)
        bench = Bench(replace(given, decide_every=slower * given.decide_every), PLACES["A"])
        bench.running(said).step(2.0 * slower, said)
        stepping, setpoint = bench.robot.stepping, bench.robot.setpoint
        ends.append(repr((stepping.memory, stepping.measures, setpoint)))
        assert all(abs(each) < 1e6 for values in stepping.memory.values() for each in values if isfinite(each))
        assert all(map(isfinite, setpoint))
        assert bench.life.phase == RUNNING, bench.life.reason
    assert ends[0] == ends[1]  # however poses arrive within a tick


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
@pytest.mark.parametrize("name", registry.names(AVOIDANCES))
def test_range_readings_beyond_the_horizon_change_nothing(name, kind):
    avoidance, random, acted = made(AVOIDANCES, name), Random(7), 0

    def any_of(most):
        return random.uniform(-most, most), random.uniform(-most, most)

    def at(distance):
        angle = random.uniform(-pi, pi)
        return distance * cos(angle), distance * sin(angle)

    for _ in range(150):
        here = own(kind, (0.0, 0.0), yaw=random.uniform(-pi, pi), velocity=(*any_of(kind.speed), 0.0))
        horizon = min(kind.radius + avoidance.horizon(here), 1e3)
        close = [at(random.uniform(kind.radius, horizon)) for _ in range(3)]
        far = [at(horizon * random.uniform(1.0 + 1e-9, 1.2)) for _ in range(30)]
        goal = (*any_of(1.0), 0.5)
        setpoint = (*any_of(kind.speed / kind.response if kind.takes == "position" else kind.speed), 0.0, 0.0)
        alone, together = (
            (avoidance.deviate(goal, here, things, 0.01), avoidance.restrain(setpoint, here, things))
            for things in (near(*close), near(*close, *far))
        )
        assert alone == together
        acted += alone != (goal, setpoint)
    assert acted > 10
