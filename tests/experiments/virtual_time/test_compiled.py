"""Compiled stretches: the same as plain runs in every bit, for every registered plug-in, a user's too."""

import math
import shutil
import sys
from dataclasses import replace
from importlib import import_module
from math import inf, sqrt
from pathlib import Path
from types import FunctionType
from typing import ClassVar

import numpy as np
import pytest

from agents.body.interface import Disturbance, Jitter
from agents.body.kinds import KINDS
from agents.body.limits import Safety
from agents.decision.lifecycle import Phase
from agents.decision.stepping import Speech, Stepping
from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_RELATIVE
from agents.plugins import registry
from agents.plugins.law import Control, Law, View
from agents.plugins.laws import Gradient
from agents.plugins.registry import AVOIDANCES, LAWS, PREDICTORS, TRIGGERS, PluginError
from agents.plugins.triggers import Trigger
from agents.vectors import UNKNOWN, ZERO, clamp, norm
from experiments.catalogue import index
from experiments.definition.experiment import (
    Arena,
    ChangeTable,
    ChannelTable,
    Formation,
    LegTable,
    LinkChannelTable,
    Obstacle,
    Outage,
    RobotTable,
    WorldTable,
)
from experiments.file import document
from experiments.virtual_time import machine, stretch
from experiments.virtual_time.translator.calls import NEW_SUMS
from tests.agents.plugins.test_every_plugin import made as plugin
from tests.experiments.virtual_time.evaluators import alike, evaluated, same
from tests.small import changed
from tests.small import pair as small_pair

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
WANTS = {"distance": BY_DISTANCE, "any": BY_DISTANCE, "relative": BY_RELATIVE, "bearing": BY_BEARING}
REMEMBERING = [name for name in registry.names(LAWS) if not issubclass(registry.struct(LAWS, name), Gradient)]
STEPS = {  # laws within the subset
    "aggregative", "average", "consensus", "cyclic-pursuit", "enclosing", "flocking", "integral", "leader-observer",
}  # fmt: skip
NATURE = {
    "all": Disturbance(position_sigma=0.0005, yaw_sigma=0.002),
    "crazyflie": Disturbance(position_sigma=0.0005, hover_jitter=Jitter(0.01), wind=(0.2, -0.1)),
    "khepera4": Disturbance(odometry_drift=0.002),
    "turtlebot3": Disturbance(latency_s=0.04),
}


@pytest.fixture(autouse=True)
def heard():
    """Nothing is refused, or the test takes it out."""
    stretch.REFUSED.clear()
    yield
    assert not stretch.REFUSED


def follower(**parts):
    """Two ground robots, of which B follows A."""
    noise = {"all": Disturbance(position_sigma=0.0005)}
    links = Formation(links={"A > B": 0.5})
    return small_pair(**{"duration_s": 4.0, "formation": links, "disturbance": noise, "trigger": "periodic", **parts})


def plugins(group):
    return [plugin(group, name) for name in registry.names(group)]


def every_plugin():
    """Experiment, and change of its robots: each has the next law, trigger, predictor, avoidance and kind."""
    quiet = [each for each in plugins(TRIGGERS) if not each.FILES]
    sending, updating = ([each for each in quiet if place in each.PLACES] for place in ("communication", "control"))
    predictors, avoidances = plugins(PREDICTORS), plugins(AVOIDANCES)
    laws = [law for law in plugins(LAWS) if isinstance(law, Gradient)]
    kinds = ("crazyflie", "khepera4", "tello", "turtlebot3", "omni", "ackermann", "double-integrator")
    count = max(map(len, (sending, updating, laws, predictors, avoidances, kinds)))

    def change(given):
        k = int(given.name[1:])
        law, avoidance = laws[k % len(laws)], (None, *avoidances)[k % (1 + len(avoidances))]
        seen = {"relative": (0.4, 0.3, 0.0), "bearing": (0.6, 0.8, math.nan), "wants": WANTS[law.NEEDS]}
        return replace(
            given, law=law, neighbours=tuple(changed(link, **seen) for link in given.neighbours),
            trigger=sending[k % len(sending)], update=updating[k % len(updating)],
            predictor=predictors[k % len(predictors)], avoidance=avoidance, avoids=avoidance is not None,
        )  # fmt: skip

    robots = {}
    for k in range(count):
        kind, start = kinds[k % len(kinds)], [0.7 * (k % 4 - 1.5), 0.7 * (k // 4 - 1.0)]
        hover = 0.5 if KINDS[kind].flies else None
        robots[f"R{k}"] = RobotTable(kind=kind, sensors=[], hover=hover, start=start)
    links = {f"R{k} - R{(k + 1) % count}": 0.6 for k in range(count)}
    experiment = follower(
        robots=robots, formation=Formation(links=links), disturbance=NATURE, duration_s=5.0,
        avoidance={"kind": "potential"}, channel=ChannelTable(delay_s=0.03),
    )  # fmt: skip
    return experiment, change


# functions of quiet modules that no quiet tick calls: they are rare, or every subclass has its own
RARE = {
    "agents.decision.position_control": {"VelocityFollower.goal"},
    "agents.decision.transmission": {"LowPass._driven", "LowPass.smooth", "Transmitter.replace_trigger", "_drawn"},
    "agents.plugins.avoidance": {
        "Avoidance.deviate", "Avoidance.horizon", "Avoidance.kept_gap", "Nearby.reserve", "Potential.horizon",
    },
    "agents.plugins.barrier": {"Barrier.horizon", "Barrier.kept_gap"},
    "agents.plugins.laws": {"Gradient.error", "Gradient.pull", "tracking_offset"},
    "agents.plugins.predictors": {"ConstantVelocity.reach", "Predictor.reach"},
    "agents.plugins.triggers": {"Trigger.fires"},
    "agents.safety.positions": {
        "Continuity.forget", "ExternalPositions.believed_yaw", "ExternalPositions.believes",
        "ExternalPositions.disbelieve", "ExternalPositions.forget",
    },
    "twins.models.differential": {"Differential.land", "Differential.place", "Differential.push"},
    "twins.models.ground": {
        "Bicycle.push", "Bicycle.rest", "Ground.land", "Ground.place", "Ground.rest", "Omni.rest",
    },
    "twins.models.motion": {
        "Motion.command", "Motion.land", "Motion.move", "Motion.place", "Motion.push", "Motion.stop", "Motion.takeoff",
    },
    "twins.models.noise": {"Noise._drawn", "Noise.refill", "Noise.reserve", "refill", "stream"},
    "twins.models.onboard_flight": {
        "OnboardFlight._climb", "OnboardFlight.blow", "OnboardFlight.land", "OnboardFlight.place",
        "OnboardFlight.stop", "OnboardFlight.takeoff",
    },
    "twins.models.quadrotor": {"Quadrotor.place"},
    "agents.decision.control_updates": set(), "agents.plugins.trigger_families": set(), "agents.vectors": set(),
    "agents.safety.motion_check": {"MotionCheck.words"}, "agents.safety.setpoint_filter": set(),
}  # fmt: skip


def functions(module):
    """Functions of a module and of its classes; special, class methods and properties are not quiet."""
    for found in vars(module).values():
        if getattr(found, "__module__", "") == module.__name__:
            inside = [found, *getattr(found, "__dict__", {}).values()]
            yield from (
                each for each in inside if isinstance(each, FunctionType) and each.__module__ == module.__name__
            )


def test_every_plugin_and_model(monkeypatch):
    """The same as in Python, and of the quiet modules every function is compiled but those that are rare."""
    monkeypatch.setattr(stretch, "DRIVERS", {})
    monkeypatch.setattr(stretch, "RECENT", {})
    experiment, change = every_plugin()
    assert same(experiment, change=change)[1] > 500
    reached = set[FunctionType]().union(*(each.program.functions for each in stretch.DRIVERS.values()))
    for name, rare in RARE.items():
        every = {each for each in functions(import_module(name)) if not each.__name__.startswith("__")}
        assert {each.__qualname__ for each in every - reached} == rare, name


@pytest.mark.parametrize("name", REMEMBERING)
def test_every_law_that_remembers(monkeypatch, name):
    """Its steps are compiled, or called back in Python between ticks that are. A user's laws are among them."""
    monkeypatch.setattr(stretch, "DRIVERS", {})
    monkeypatch.setattr(stretch, "RECENT", {})
    experiment, change = remembering(plugin(LAWS, name))
    assert same(experiment, change=change)[1] > 200
    called_back = [each for loop in stretch.DRIVERS.values() for each in loop.program.called_back]
    assert name not in STEPS or not called_back or sys.version_info >= NEW_SUMS
    if not name.startswith("m"):
        same(experiment, change=change, lean=True, seed=2)


def remembering(law):
    """Experiment of three robots, of which A follows a circle, and change of its robots, which have this law."""
    circle = {"kind": "circle", "radius": 0.3, "period_s": 9.0}
    starts = {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [-0.3, 0.8]}
    robots = {each: RobotTable(kind="khepera4", start=start) for each, start in starts.items()}
    links = Formation(links={"A > B": 0.8, "A > C": 0.8, "B - C": 0.9})
    seen = {"relative": (0.4, 0.3, 0.0), "bearing": (0.6, 0.8, math.nan), "wants": WANTS.get(law.NEEDS, BY_DISTANCE)}

    def change(given):
        neighbours = tuple(changed(link, **seen) for link in given.neighbours)
        return replace(given, law=law, neighbours=neighbours, trigger=plugin(TRIGGERS, "send-on-delta"))

    experiment = follower(
        robots=robots, formation=links, duration_s=3.0, channel=ChannelTable(delay_s=0.03),
        timeline=[LegTable(at_s=0.5, robot="A", plan=circle)],
    )  # fmt: skip
    return experiment, change


def faster(self, view):
    """`Stepping.step`, changed."""
    control = self.rehearse(view)
    x, y, z = ZERO if control.velocity is None else control.velocity
    self.gives_velocity, self.velocity = control.velocity is not None, (1.5 * x, 1.5 * y, z)
    self.memory, self.measures = control.memory, control.measures
    self.stepped = self.tick
    if self.speech is not None:
        self.speech.update(self.memory)


def hoarse(self, memory):
    """`Speech.update`, changed."""
    self.now = {name: tuple(map(halved, memory[name])) for name in self.metres}
    self.stepped, self.current, self.change = True, False, inf


def halved(value):
    return 0.5 * value


def turned(self, neighbours, position, velocity, yaw, target, speed, leads):  # noqa: PLR0917 - as `Stepping.view`
    """`Stepping.view`, changed."""
    said = {} if self.speech is None else self.speech.said
    return View(
        self.facts, said, neighbours, self.tick * self.tick_s, position, velocity, yaw + 0.1, target, speed, self.scan,
        self.deviation, leads, self.moves, step_s=2.0 * self.length(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("owner", "name", "other"), [(Stepping, "step", faster), (Speech, "update", hoarse), (Stepping, "view", turned)]
)
def test_compiled_steps_are_those_of_the_process(monkeypatch, owner, name, other):
    """A changed decision changes compiled ticks and plain ones alike: it has one source."""
    monkeypatch.setattr(stretch, "DRIVERS", {})
    monkeypatch.setattr(stretch, "RECENT", {})
    made = remembering(plugin(LAWS, "leader-observer"))
    before, ticks = same(made[0], change=made[1])
    monkeypatch.setattr(owner, name, other)
    after, changed_ticks = same(made[0], change=made[1])
    assert min(ticks, changed_ticks) > 200
    assert not any(loop.program.called_back for loop in stretch.DRIVERS.values()) or sys.version_info >= NEW_SUMS
    ends = [(log.position[-1], {name: each[-1] for name, each in log.memory.items()}) for log in (before, after)]
    assert not alike(*ends)


class Growing(Trigger, frozen=True):
    """A trigger with whole numbers beyond those of C, once the run has lasted."""

    def fires(self, view):
        return view.since_event > 0.03 or (view.since_start > 1.2 and (1 << 60) * 4 > 7)


def test_steps_of_failed_stretch_are_taken_back():
    def change(given):
        neighbours = tuple(changed(link, relative=(0.4, 0.3, 0.0), wants=BY_RELATIVE) for link in given.neighbours)
        return replace(given, law=plugin(LAWS, "leader-observer"), trigger=Growing(), neighbours=neighbours)

    _, ticks = same(follower(duration_s=3.0, channel=ChannelTable(delay_s=0.2)), change=change)
    assert ticks < 150


class Failing(Law, frozen=True):
    """A law that fails in its run."""

    def step(self, view, memory):
        return Control(velocity=(0.1 / max(1.0 - view.time, 0.0), 0.0, math.nan))


def test_law_that_fails_in_a_step():
    faults = set()
    for compiled in (False, True):
        with pytest.raises((PluginError, ZeroDivisionError)) as caught:
            evaluated(follower(), compiled=compiled, change=lambda given: replace(given, law=Failing()))
        faults.add(str(caught.value))
    assert len(faults) == 1


@pytest.mark.parametrize("law", ["distance", "consensus"])
def test_changing_formations_are_compiled(law):
    change = ChangeTable(at_s=1.0, over_s=1.0, links={"A > B": 0.7})
    made = follower(formation=Formation(links={"A > B": 0.5}, law=law, changes=[change]))
    assert same(made)[1] > 200
    assert same(made, change=lambda given: replace(given, update=plugin(TRIGGERS, "send-on-delta")))[1] > 200


GAIN = 0.2


class Foreign(Gradient, frozen=True):
    """A law within the subset, with what compilers like to change; it fails when its robot is far from a neighbour."""

    farthest: float = 9.0
    POWER: ClassVar[float] = 2.0

    def pull(self, apart, link):
        x, y, z = apart
        length: float = max(sqrt(x**2 + y**2.0 + z**self.POWER), 0.1)
        gain = GAIN * math.exp(-(length**3)) * (link.distance - length) / length / sqrt(self.farthest - length)
        return gain * x, gain * y, gain * z

    def error(self, apart, link):
        return abs(link.distance - math.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2))


class Spring(Foreign, frozen=True):
    """A law with functions of another module."""

    constant: float = 0.3

    def pull(self, apart, link):
        length = max(norm(apart), 1e-6)
        k = self.constant * clamp((link.distance - length) / length, -0.5, 0.5)
        return k * apart[0], k * apart[1], k * apart[2]


class Trying(Foreign, frozen=True):
    """A law outside of the subset."""

    def pull(self, apart, link):
        try:
            return super().pull(apart, link)
        except ValueError:
            return UNKNOWN


class Counting(Trigger, frozen=True):
    """A trigger that remembers, with a first value that is no float."""

    MEMORY: ClassVar = {"sum": 0}

    def fires(self, view):
        view.memory.sum += 0.3
        return view.memory.sum % 1.0 < 0.2


def test_stretches_of_legs_hazards_and_users_laws():
    """The same compilation covers followers of A with different laws, other seeds, and samples of positions alone.

    And a robot that lands early, a hazard, and a law that fails.
    """
    line = {"kind": "line", "move_by": [0.2, 0.1], "speed": 0.1}
    circle = {"kind": "circle", "radius": 0.3, "period_s": 9.0}
    legs = [LegTable(at_s=at, robot="A", plan=plan) for at, plan in ((2.0, line), (11.3, circle))]
    starts = {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [-0.4, 0.8]}
    robots = {name: RobotTable(kind="crazyflie", hover=0.5, start=start) for name, start in starts.items()}
    made = follower(
        robots=robots, formation=Formation(links={f"A > {name}": 0.8 for name in "BC"}), duration_s=25.0,
        timeline=legs, safety=Safety(battery_low=0.96), avoidance={"kind": "potential"},
    )  # fmt: skip

    def with_laws(farthest):
        parts = {
            "A": {"trigger": plugin(TRIGGERS, "send-on-delta")},
            "B": {"law": Foreign(farthest=farthest), "trigger": Counting()},
            "C": {"law": Spring(), "predictor": plugin(PREDICTORS, "constant-velocity")},
        }
        return lambda given: replace(given, **parts[given.name])

    lands = changed(made, robots=robots | {"A": changed(robots["A"], lands_at_s=8.0)}, safety=Safety())
    log, _ = same(lands, change=with_laws(9.0))
    assert log.phase[np.argmax(log.time > 14.0)].tolist() == [Phase.DONE, Phase.RUNNING, Phase.RUNNING]
    for seed, lean in ((1, False), (2, False), (3, True)):
        log, ticks = same(made, seed=seed, lean=lean, change=with_laws(9.0))
        assert ticks > 1500
        low = {row for row, incident in log.incidents if incident.cause.name == "BATTERY" and incident.time < 20.0}
        assert low == {0, 1, 2}
    faults = set()
    for compiled in (False, True):
        with pytest.raises((PluginError, ValueError)) as caught:
            evaluated(made, compiled=compiled, change=with_laws(0.4))
        faults.add(str(caught.value))
    assert len(faults) == 1


def test_take_off_and_landing_are_compiled():
    """A flight is one stretch, from the first robot that is ready until all are done, whether or not one has a plan."""
    plan = LegTable(at_s=1.0, robot="A", plan={"kind": "line", "move_by": [0.0, 0.4], "speed": 0.2})
    for kind in ({"kind": "khepera4"}, {"kind": "crazyflie", "hover": 0.5}):
        robots = {"A": RobotTable(**kind, start=[0.0, 0.0]), "B": RobotTable(**kind, start=[0.5, 0.0])}
        for links, timeline in (({"A > B": 0.5, "B > A": 0.5}, []), ({"A > B": 0.5}, [plan])):
            log, ticks = same(follower(robots=robots, formation=Formation(links=links), timeline=timeline))
            assert ticks >= (log.ended - log.time[0]) * log.ticks / 4.0 - 5  # without take-off and landing it lasts 4 s


def test_way_aside_before_a_landing_is_flown_plain():
    """A drone above another one moves aside for 1.43 s before it lands."""
    robots = {
        name: RobotTable(kind="crazyflie", start=[x, 0.0], hover=z)
        for name, x, z in (("A", 0.0, 1.2), ("B", 0.17, 0.4))
    }
    log, ticks = same(follower(robots=robots, formation=Formation(links={"A > B": 0.82, "B > A": 0.82})))
    assert [change.cause.name for _, change in log.incidents] == ["BELOW", "BELOW"]
    assert 0 < (log.ended - log.time[0]) * log.ticks / 4.0 - 143 - ticks < 10


def test_law_outside_of_the_subset_is_flown_plain():
    _, ticks = same(follower(duration_s=1.0), change=lambda given: replace(given, law=Trying()))
    assert ticks == 0
    (reason,) = stretch.REFUSED.values()
    stretch.REFUSED.clear()
    assert "try" in reason
    assert f"{Path(__file__).name}:" in reason


CHANNELS = {
    "loss": ChannelTable(loss=0.3),
    "bursts": ChannelTable(loss=0.2, burst=4.0, delay_s=0.0),  # received within the tick
    "jitter": ChannelTable(jitter_s=0.2, delay_s=0.02),  # samples overtake others
    "outage": ChannelTable(outages=[Outage(from_s=0.5, until_s=1.5)]),
    "by link": ChannelTable(links={"A > B": LinkChannelTable(loss=0.5, jitter_s=0.1)}),
    "all": ChannelTable(loss=0.1, burst=3.0, jitter_s=0.3, delay_s=0.05, outages=[Outage(from_s=1.0, until_s=1.2)]),
}


@pytest.mark.parametrize("law", ["distance", "leader-observer", "coverage"])
@pytest.mark.parametrize("trigger", ["periodic", "send-on-delta"])
@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_effects_of_the_network_are_compiled(channel, trigger, law):
    """Losses and arrivals follow from the seed: the same samples are lost, and the rest arrives at the same times."""
    experiment, change = remembering(plugin(LAWS, law))
    experiment = changed(experiment, channel=channel)

    def with_trigger(given):
        return replace(change(given), trigger=plugin(TRIGGERS, trigger))

    for seed, lean in ((1, False), (2, True)):
        log, ticks = same(experiment, change=with_trigger, seed=seed, lean=lean)
        assert ticks > 300
        assert (sum(log.lost) > 0) == (channel is not CHANNELS["jitter"])


@pytest.mark.parametrize("channel", [ChannelTable(), CHANNELS["all"]])
def test_robots_without_links_are_compiled(channel):
    assert same(follower(formation=Formation(links={}), channel=channel))[1] > 300


def test_limited_bandwidth_is_not_compiled():
    assert same(follower(duration_s=1.0, channel=ChannelTable(bandwidth=1e5)))[1] == 0


@pytest.mark.parametrize("kind", ["turtlebot3", "crazyflie"])
@pytest.mark.parametrize("avoidance", [None, "potential", "barrier"])
def test_worlds_are_compiled_around_their_engine(kind, avoidance):
    """Robots that touch, see each other, a post and a wall, and an obstacle that moves; two of three seeds are lean."""
    hover = 0.5 if KINDS[kind].flies else None
    starts = {"A": [-0.5, 0.0], "B": [0.5, 0.05], "C": [0.0, 0.6]}
    robots = {name: RobotTable(kind=kind, hover=hover, start=start) for name, start in starts.items()}
    cart = Obstacle(
        box=(0.2, 0.2), at=(-0.9, 0.6), height=0.8, plan={"kind": "line", "move_by": [1.8, 0.0], "speed": 0.5}
    )
    arena = Arena(size=(3.0, 3.0, 2.5), obstacles={"post": Obstacle(radius=0.1, at=(0.0, -0.6)), "cart": cart})
    line = {"kind": "line", "move_by": [0.9, -0.5], "speed": 0.2}
    experiment = follower(
        robots=robots, arena=arena, world=WorldTable(engine="pymunk"), duration_s=6.0,
        formation=Formation(links={"A > B": 0.2, "B - C": 0.2}), timeline=[LegTable(at_s=1.0, robot="A", plan=line)],
        channel=CHANNELS["loss"], avoidance=None if avoidance is None else {"kind": avoidance}, disturbance=NATURE,
    )  # fmt: skip
    touches = 0
    for seed, lean in ((1, False), (2, True), (3, True)):
        log, ticks = same(experiment, seed=seed, lean=lean)
        assert ticks > 100
        touches += len(log.touches)
    assert touches > 0 or hover is not None or avoidance is not None


@pytest.mark.nightly
@pytest.mark.parametrize("name", index.names())
def test_cases_of_the_catalogue(name):
    """Every case with three seeds; those with a central controller are flown plain."""
    for case in document.read(name).cases().values():
        for seed in range(1, 4):
            same(case.experiment, seed=seed, lean=seed > 1)
    stretch.REFUSED.clear()


def test_failure_in_a_world_begins_the_run_again():
    experiment = follower(duration_s=3.0, world=WorldTable(engine="pymunk"))
    for _ in range(2):
        _, ticks = same(experiment, change=lambda given: replace(given, trigger=Growing()))
        assert ticks == 0


def test_changed_constant_of_a_module_counts(monkeypatch):
    """As in a notebook: its next run has the new number."""
    experiment, change = follower(duration_s=2.0), lambda given: replace(given, law=Foreign())
    first, _ = same(experiment, change=change)
    monkeypatch.setitem(globals(), "GAIN", 0.4)
    second, ticks = same(experiment, change=change)
    assert ticks > 100
    assert not alike(first.goal, second.goal)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
@pytest.mark.parametrize(
    ("every", "flags"),
    [
        pytest.param(False, ("", ""), id="cc"),
        pytest.param(True, ("", ""), id="every-cc", marks=pytest.mark.nightly),
        pytest.param(True, ("-O1", "-O0 -fno-wrapv -fsanitize=undefined"), id="sanitized", marks=pytest.mark.nightly),
    ],
)
def test_plugins_by_cc(monkeypatch, tmp_path, capfd, every, flags):
    """The same bits, and nothing that C leaves undefined: of one pair of robots, or of every plug-in."""
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(stretch, "OFTEN_S", 0.0)
    monkeypatch.setattr(machine, "FLAGS", machine.FLAGS.replace(*flags))
    for known in ("DRIVERS", "RECENT"):
        monkeypatch.setattr(stretch, known, {})
    experiment, change = every_plugin() if every else (follower(), None)
    assert same(experiment, change=change)[1] > 100
    assert list((tmp_path / "programs").glob("*.so"))
    assert "runtime error" not in capfd.readouterr().err
