"""From an experiment to what its robots are told (`Assignment`) and their bodies opened with (`BodyRequest`)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from agents.arrays import Index, Mask
from agents.body.limits import Limits
from agents.decision.assignment import Assignment
from agents.formation.graph import Links, links
from agents.plugins import registry
from agents.plugins.avoidance import Avoidance
from agents.plugins.planners import Leg
from agents.plugins.predictors import HOLD, Predictor
from experiments.definition.bodies import VICON_TWIN, WORLD, disturbance, hover, kinds
from experiments.definition.experiment import Experiment, Hybrid
from experiments.definition.formation import FormationArrays, anchors_of
from experiments.definition.links import parse_links


def all_links(experiment: Experiment) -> Links:
    """Every link that the formation may have, with the targets of the beginning; rows in the order of the file."""
    return FormationArrays.of(experiment, tuple(experiment.robots)).links


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
    pattern = FormationArrays.of(experiment, names).without_listeners(_rows(experiment, guided(experiment)))
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
    built: Avoidance = registry.build(registry.AVOIDANCES, experiment.avoidance)
    return built


def predictor(experiment: Experiment) -> Predictor:
    """Where a robot is believed to be between two messages: as the experiment says, else as its trigger needs it."""
    chosen = experiment.prediction
    if chosen is None:
        trigger = registry.struct(registry.TRIGGERS, registry.split(experiment.trigger)[0])
        chosen = getattr(trigger, "prediction", "hold")
    built: Predictor = registry.build(registry.PREDICTORS, chosen)
    return HOLD if built == HOLD else built


def leaders(experiment: Experiment) -> list[str]:
    """The leader of the file, or every robot that listens to nobody and has no anchor (none, if that would be all)."""
    if experiment.formation.leader is not None:
        return [experiment.formation.leader]
    listening = {listener for listener, _, _, _ in parse_links(experiment)}
    silent = [name for name in experiment.robots if name not in listening | set(experiment.formation.anchors)]
    return silent if len(silent) < len(experiment.robots) else []


def _patience(experiment: Experiment, name: str) -> float:
    """How long a robot holds without a position [s]: one whose world is gone cannot move, and may wait for it."""
    return experiment.world.patience_s if experiment.robots[name].body == WORLD else experiment.safety.blind_s


def limits(experiment: Experiment, names: Sequence[str], copies: int = 1) -> Limits:
    """Limits of robots `names`, repeated `copies` times."""
    x, y, z = experiment.arena.size
    return Limits(
        low=np.array([-x / 2, -y / 2, 0.0]),
        high=np.array([x / 2, y / 2, z]),
        hold_s=np.array([_patience(experiment, name) for name in names] * copies),
        **msgspec.structs.asdict(experiment.safety),
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
            Leg(leg.at_s, registry.build("zenpark.planners", leg.plan))
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
    pattern = FormationArrays.of(experiment, everyone).without_listeners(_rows(experiment, others)).heard_by(rows)
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
        law=registry.build("zenpark.laws", experiment.formation.law),
        trigger=registry.build("zenpark.triggers", experiment.trigger),
        predictor=predictor(experiment),
        update=None
        if experiment.formation.update is None
        else registry.build(registry.TRIGGERS, experiment.formation.update),
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
