"""From an experiment to what its robots are told (`Assignment`) and their bodies opened with (`BodyRequest`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from agents import plugins
from agents.assignment import Assignment
from agents.avoidance import Avoidance
from agents.body import BodyRequest, Disturbance
from agents.graph import Links, links
from agents.keys import Keys
from agents.kinds import KINDS, Kind
from agents.planning import Leg
from agents.prediction import HOLD, Predictor
from agents.rows import Array, Index, Mask
from agents.safety import Limits
from experiments import outlines
from experiments.experiment import Experiment, Hybrid
from experiments.formation import Pattern, anchors_of
from experiments.links import parse_links
from twins.scene import Scene
from twins.sensors import OF_KIND
from twins.world import World

TRIES: Final = 200  # places that are drawn for a robot before it stays where the file puts it
CLEAR: Final = 0.02  # [m] between robots that are scattered
WORLD: Final = "world"  # the body of a robot that lives in the twin service
VICON_TWIN: Final = "vicon-twin"  # motion capture that is simulated as well


def kinds(experiment: Experiment, names: Sequence[str]) -> tuple[Kind, ...]:
    """The kinds of these robots."""
    return tuple(KINDS[experiment.robots[name].kind] for name in names)


def all_links(experiment: Experiment) -> Links:
    """Every link that the formation may have, with the targets of the beginning; rows in the order of the file."""
    return Pattern.of(experiment, tuple(experiment.robots)).links


def measured(experiment: Experiment) -> list[str]:
    """Robots whose positions motion capture says.

    Where robots of the world are, the world itself says, as two that did would contradict each other; but a simulated
    motion capture sees them, and then the world leaves it to that.
    """
    simulated = experiment.positioning == VICON_TWIN
    return [
        name
        for name, robot in experiment.robots.items()
        if robot.position == "external" and (simulated or robot.body != WORLD)
    ]


def guided(experiment: Experiment) -> tuple[str, ...]:
    """The robots for which a centre decides, in the order of the file."""
    if isinstance(experiment.architecture, Hybrid):
        return tuple(name for name in experiment.robots if name in experiment.architecture.robots)
    return tuple(experiment.robots) if experiment.architecture == "centralised" else ()


def heard_links(experiment: Experiment) -> Links:
    """Every link on which robots hear each other: those for the formation, then those that only avoidance needs."""
    names = tuple(experiment.robots)
    pattern = Pattern.of(experiment, names).without_listeners(_rows(experiment, guided(experiment)))
    return pattern.links.and_then(watch_links(experiment))


def watch_links(experiment: Experiment) -> Links:
    """Links that only avoidance needs: between all robots that no law links, if it hears all; else between neighbours.

    Robots that the centre guides have no law of their own.
    """
    avoidance = _avoidance(experiment)
    nobody, centrally = links([], [], []), set(guided(experiment))
    if avoidance is None or not (avoidance.hears == "all" or centrally):
        return nobody
    linked = {(listener, speaker) for listener, speaker, _, _ in parse_links(experiment)}
    there = {(listener, speaker) for listener, speaker in linked if listener not in centrally}
    robots = list(enumerate(experiment.robots))
    listening = [(i, a) for i, a in robots if experiment.robots[a].avoids]
    pairs = [
        (i, j)
        for i, a in listening
        for j, b in robots
        if i != j and (a, b) not in there and (avoidance.hears == "all" or (a, b) in linked)
    ]
    return links(pairs, [1.0] * len(pairs), [1.0] * len(pairs)) if pairs else nobody


def _rows(experiment: Experiment, names: Sequence[str]) -> Index:
    everyone = list(experiment.robots)
    return np.array([everyone.index(name) for name in names], dtype=np.intp)


def _avoidance(experiment: Experiment) -> Avoidance | None:
    if experiment.avoidance is None:
        return None
    built: Avoidance = plugins.build(plugins.AVOIDANCES, experiment.avoidance)
    return built


def predictor(experiment: Experiment) -> Predictor:
    """Where a robot is believed to be between two messages: as the experiment says, else as its trigger needs it."""
    chosen = experiment.prediction
    if chosen is None:
        trigger = plugins.struct(plugins.TRIGGERS, plugins.split(experiment.trigger)[0])
        chosen = getattr(trigger, "prediction", "hold")
    built: Predictor = plugins.build(plugins.PREDICTORS, chosen)
    return HOLD if built == HOLD else built


def leaders(experiment: Experiment) -> list[str]:
    """The leader of the file, or every robot that listens to nobody and has no anchor (none, if that would be all)."""
    if experiment.formation.leader is not None:
        return [experiment.formation.leader]
    listening = {listener for listener, _, _, _ in parse_links(experiment)}
    silent = [name for name in experiment.robots if name not in listening | set(experiment.formation.anchors)]
    return silent if len(silent) < len(experiment.robots) else []


def start(experiment: Experiment, names: Sequence[str]) -> tuple[Array, Array]:
    """Where robots start: position (n, 3) [m] on the floor and yaw (n,) [rad]."""
    given = [(*experiment.robots[name].start, 0.0)[:3] for name in names]
    pose = np.array(given, dtype=float).reshape(-1, 3)
    return np.concatenate([pose[:, :2], np.zeros((len(pose), 1))], axis=1), pose[:, 2]


def scattered(experiment: Experiment, names: Sequence[str], seed: int) -> tuple[Array, Array]:
    """As `start`, scattered by the seed as the file asks; who is scattered overlaps no other robot and no obstacle.

    A place is drawn for each robot of the experiment, in the order of the file, whoever asks: all processes agree.
    """
    position, yaw = start(experiment, tuple(experiment.robots))
    begin = experiment.start
    if begin.scatter > 0.0 or begin.scatter_yaw > 0.0:
        rng = np.random.default_rng([seed, 0x73746172])
        kinds_of, stands = kinds(experiment, tuple(experiment.robots)), scene(experiment)
        radius = np.array([kind.radius for kind in kinds_of])
        half = 0.5 * np.array(experiment.arena.size[:2]) - experiment.safety.margin
        given = position[:, :2].copy()
        for row in range(len(position)):
            yaw[row] += begin.scatter_yaw * rng.uniform(-1.0, 1.0)
            for _ in range(TRIES):
                place = np.clip(
                    given[row] + begin.scatter * rng.uniform(-1.0, 1.0, 2), radius[row] - half, half - radius[row]
                )
                gap = np.hypot(*(position[:, :2] - place).T) - radius - radius[row]
                gap[row] = np.inf
                if (gap > CLEAR).all() and _free(stands, place, kinds_of[row]):
                    position[row, :2] = place
                    break
    rows = [list(experiment.robots).index(name) for name in names]
    return position[rows], yaw[rows]


def _free(stands: Scene, place: Array, kind: Kind) -> bool:
    """Whether a robot that stands at `place` (2,) [m] keeps clear of all obstacles."""
    return all(
        outlines.distance(stands, k, stands.pose[k], place) > kind.radius + CLEAR
        for k in range(len(stands.names))
        if outlines.at_height(stands, k, 0.0, kind.height)
    )


def world(experiment: Experiment, names: Sequence[str], copies: int = 1, *, sensing: bool | None = None) -> World:
    """The place that `names` share, in `copies`; with range sensors if somebody uses them, or as `sensing` says."""
    used = experiment.avoidance is not None if sensing is None else sensing
    carried = []
    for name in names:
        robot = experiment.robots[name]
        own = OF_KIND[robot.kind] if robot.sensors is None else tuple(robot.sensors)
        carried.append(own if used or robot.sensors else ())
    return World(
        copy=np.repeat(np.arange(copies), len(names)),
        scene=scene(experiment),
        engine=experiment.world.engine,
        sensors=tuple(carried) * copies,
        sensor_noise=experiment.world.sensor_noise,
        mirrored=np.zeros(len(names) * copies, dtype=bool),
    )


def scene(experiment: Experiment) -> Scene:
    """What stands in the arena."""
    arena = experiment.arena
    plans = {
        name: plugins.build(plugins.PLANNERS, obstacle.plan)
        for name, obstacle in arena.obstacles.items()
        if obstacle.plan is not None
    }
    return Scene.furnished(arena.size, arena.obstacles, plans, walled=arena.walls)


def shadows(experiment: Experiment, names: Sequence[str], copies: int = 1) -> Array:
    """How often the twin beside each robot is put onto it (n,) [s]: infinite for once, NaN for robots without one."""
    period = []
    for name in names:
        shadow = experiment.robots[name].shadow
        period.append(np.nan if shadow is None else np.inf if shadow.restart_s is None else shadow.restart_s)
    return np.tile(np.array(period), copies)


def hover(experiment: Experiment, names: Sequence[str]) -> Array:
    """Heights that robots hold (n,) [m], NaN for ground robots."""
    return np.array([experiment.robots[name].hover or np.nan for name in names])


def _patience(experiment: Experiment, name: str) -> float:
    """How long a robot holds without a position [s]: one whose world is gone cannot move, and may wait for it."""
    return experiment.world.patience_s if experiment.robots[name].body == WORLD else experiment.safety.blind_s


def limits(experiment: Experiment, names: Sequence[str], copies: int = 1) -> Limits:
    """For `agents.safety`."""
    x, y, z = experiment.arena.size
    safety = experiment.safety
    return Limits(
        low=np.array([-x / 2, -y / 2, 0.0]),
        high=np.array([x / 2, y / 2, z]),
        margin=safety.margin,
        speed=np.inf if safety.speed is None else safety.speed,
        goal_step=safety.goal_step,
        own_silence_s=safety.own_silence_s,
        blind_s=np.array([_patience(experiment, name) for name in names] * copies),
        link_silence_s=safety.link_silence_s,
        cut_outside=safety.cut_outside,
        separation=safety.separation,
        overspeed=safety.overspeed,
        tilt=safety.tilt,
        battery_low=safety.battery_low,
        battery_min=safety.battery_min,
        offline_s=safety.offline_s,
        landing_s=safety.landing_s,
        lost_neighbour=safety.lost_neighbour,
        lost_conductor=safety.lost_conductor,
    )


def _legs(
    experiment: Experiment, names: Sequence[str], only: Sequence[str]
) -> tuple[tuple[Index, tuple[Leg, ...]], ...]:
    """Plans of some of the robots `names`, each with its row."""
    plans = []
    for row, name in enumerate(names):
        if name not in only:
            continue
        legs = tuple(
            Leg(leg.at_s, plugins.build("zenpark.planners", leg.plan))
            for leg in experiment.timeline
            if leg.robot == name
        )
        if legs:
            plans.append((np.array([row], dtype=np.intp), legs))
    return tuple(plans)


def assign(experiment: Experiment, names: Sequence[str], copies: int = 1) -> Assignment:
    """What `names` are told; with `copies`, the whole experiment side by side for as many repetitions.

    Raises:
        ValueError: If copies are asked for but not of all robots: their links would point nowhere.
    """
    return _assign(experiment, names, copies, centrally=False)


def assign_centre(experiment: Experiment, copies: int = 1) -> Assignment:
    """What the centre is told: of all robots, with links, anchors and plans of those that it guides."""
    return _assign(experiment, tuple(experiment.robots), copies, centrally=True)


def _assign(experiment: Experiment, names: Sequence[str], copies: int, *, centrally: bool) -> Assignment:
    """For robots, or for the centre."""
    everyone = tuple(experiment.robots)
    if copies > 1 and tuple(names) != everyone:
        raise ValueError("only the whole experiment can be repeated")
    rows, steered = _rows(experiment, names), guided(experiment)
    others = [name for name in everyone if (name in steered) != centrally]
    mine = [name for name in names if name not in others]
    pattern = Pattern.of(experiment, everyone).without_listeners(_rows(experiment, others)).heard_by(rows)
    watched = links([], [], []) if centrally else watch_links(experiment).of(rows)
    anchors = anchors_of(experiment, names, only=mine)
    only_watched = np.repeat([False, True], [len(pattern.links), len(watched)])
    legs = _legs(experiment, names, only=mine)
    if len(watched):
        pattern = pattern.and_then(watched)
    if copies > 1:
        pattern = pattern.repeated(copies, len(names))
        anchors = None if anchors is None else anchors.repeated(copies, len(names))
        legs = tuple(
            (np.concatenate([group + c * len(names) for c in range(copies)]), planned) for group, planned in legs
        )
    rates = experiment.rates
    return Assignment(
        names=tuple(names) * copies,
        kinds=kinds(experiment, names) * copies,
        hover=np.tile(hover(experiment, names), copies),
        speakers=everyone * copies,
        links=pattern.links,
        changes=pattern.changes,
        presence=pattern.presence,
        anchors=anchors,
        law=plugins.build("zenpark.laws", experiment.formation.law),
        trigger=plugins.build("zenpark.triggers", experiment.trigger),
        predictor=predictor(experiment),
        update=None
        if experiment.formation.update is None
        else plugins.build(plugins.TRIGGERS, experiment.formation.update),
        clamp=experiment.formation.clamp,
        tracking_gain=experiment.formation.tracking_gain,
        legs=legs,
        limits=limits(experiment, names, copies),
        avoidance=None if centrally else _avoidance(experiment),
        speaker_kinds=kinds(experiment, everyone) * copies,
        watched=np.tile(only_watched, copies) if len(watched) else None,
        avoids=np.array([experiment.robots[name].avoids for name in names] * copies),
        body_hz=rates.body_hz,
        pose_every=round(rates.body_hz / rates.pose_hz),
        decide_every=round(rates.body_hz / rates.coordination_hz),
        duration=experiment.duration_s,
        patience_s=experiment.start.deadline_s if experiment.start.missing == "go-on" else None,
        guided=np.array([name in steered for name in names] * copies) if steered else None,
        waited_for=_waited_for(experiment, pattern.links, copies),
    )


def _waited_for(experiment: Experiment, links: Links, copies: int) -> Mask | None:
    """Links (E,) from robots that are not on standby; None if nobody is."""
    standby = np.array([robot.standby for robot in experiment.robots.values()] * copies)
    return ~standby[links.speaker] if standby.any() else None


def disturbance(experiment: Experiment, name: str) -> Disturbance:
    """What nature adds to a robot: `all`, overridden by its kind, overridden by its own name, field by field."""
    merged: dict[str, object] = {}
    for scope in ("all", experiment.robots[name].kind, name):
        if (given := experiment.disturbance.get(scope)) is not None:
            fields = msgspec.structs.asdict(given)
            merged.update({field: value for field, value in fields.items() if value is not None})
    return Disturbance(**merged)  # type: ignore[arg-type]


def uses_chance(experiment: Experiment) -> bool:
    """Whether anything of an experiment depends on its seed: starts, noise of twins, the modelled network."""
    nature = [disturbance(experiment, name) for name in experiment.robots]
    noisy = any(
        each.position_sigma or each.yaw_sigma or each.odometry_drift or (each.hover_jitter and each.hover_jitter.sigma)
        for each in nature
    )
    scattered = bool(experiment.start.scatter or experiment.start.scatter_yaw)
    channel, links = experiment.channel, experiment.channel.links.values()
    lossy = channel.loss or channel.jitter_s or any(each.loss or each.jitter_s for each in links)
    sees = experiment.avoidance is not None and experiment.world.sensor_noise > 0.0
    return bool(noisy or scattered or lossy or sees)


def request(
    experiment: Experiment, names: Sequence[str], seeds: Sequence[int], endpoints: Sequence[str] = ()
) -> BodyRequest:
    """What the bodies of `names` are opened with, one repetition for each seed; `endpoints` are the routers.

    Twins start where `scattered` puts them; hardware is where it is.
    """
    copies = len(seeds)
    placed = [scattered(experiment, names, seed) for seed in seeds]
    return BodyRequest(
        names=tuple(names) * copies,
        kinds=kinds(experiment, names) * copies,
        addresses=tuple(experiment.robots[name].body for name in names) * copies,
        start=np.concatenate([position for position, _ in placed]),
        yaw=np.concatenate([yaw for _, yaw in placed]),
        rate_hz=experiment.rates.body_hz,
        seeds=tuple(seed for seed in seeds for _ in names),
        disturbance=tuple(disturbance(experiment, name) for name in names) * copies,
        external=tuple(experiment.robots[name].position == "external" for name in names) * copies,
        device=tuple(experiment.robots[name].device for name in names) * copies,
        endpoints=tuple(endpoints),
        keys=Keys(experiment.network.realm),
    )
