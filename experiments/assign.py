"""From an experiment to what its robots are told (`Assignment`) and their bodies opened with (`BodyRequest`)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from agents import plugins
from agents.agent import Assignment
from agents.body import BodyRequest, Disturbance
from agents.graph import Links, links
from agents.keys import Keys
from agents.kinds import KINDS, Kind
from agents.planning import Leg
from agents.rows import Array, Index
from agents.safety import Limits
from experiments.experiment import Experiment
from experiments.links import parse_links


def kinds(experiment: Experiment, names: Sequence[str]) -> tuple[Kind, ...]:
    """The kinds of these robots."""
    return tuple(KINDS[experiment.robots[name].kind] for name in names)


def all_links(experiment: Experiment) -> Links:
    """Every link of the experiment; rows in the order of the file."""
    number = {name: row for row, name in enumerate(experiment.robots)}
    parsed = parse_links(experiment)
    return links(
        [(number[listener], number[speaker]) for listener, speaker, _, _ in parsed],
        [distance for _, _, distance, _ in parsed],
        [gain for _, _, _, gain in parsed],
    )


def leaders(experiment: Experiment) -> list[str]:
    """The leader of the file, or every robot that listens to nobody (none, if that would be all of them)."""
    if experiment.formation.leader is not None:
        return [experiment.formation.leader]
    listening = {listener for listener, _, _, _ in parse_links(experiment)}
    silent = [name for name in experiment.robots if name not in listening]
    return silent if len(silent) < len(experiment.robots) else []


def start(experiment: Experiment, names: Sequence[str]) -> tuple[Array, Array]:
    """Where robots start: position (n, 3) [m] on the floor and yaw (n,) [rad]."""
    given = [(*experiment.robots[name].start, 0.0)[:3] for name in names]
    pose = np.array(given, dtype=float).reshape(-1, 3)
    return np.concatenate([pose[:, :2], np.zeros((len(pose), 1))], axis=1), pose[:, 2]


def hover(experiment: Experiment, names: Sequence[str]) -> Array:
    """Heights that robots hold (n,) [m], NaN for ground robots."""
    return np.array([experiment.robots[name].hover or np.nan for name in names])


def limits(experiment: Experiment) -> Limits:
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
        link_silence_s=safety.link_silence_s,
    )


def _legs(experiment: Experiment, names: Sequence[str]) -> tuple[tuple[Index, tuple[Leg, ...]], ...]:
    """Plans of these robots, each with its row."""
    plans = []
    for row, name in enumerate(names):
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
    everyone = tuple(experiment.robots)
    if copies > 1 and tuple(names) != everyone:
        raise ValueError("only the whole experiment can be repeated")
    rows = np.array([everyone.index(name) for name in names], dtype=np.intp)
    net = all_links(experiment).of(rows)
    legs = _legs(experiment, names)
    if copies > 1:
        net = net.repeated(copies, len(names))
        legs = tuple(
            (np.concatenate([group + c * len(names) for c in range(copies)]), planned) for group, planned in legs
        )
    rates = experiment.rates
    return Assignment(
        names=tuple(names) * copies,
        kinds=kinds(experiment, names) * copies,
        hover=np.tile(hover(experiment, names), copies),
        speakers=everyone * copies,
        links=net,
        law=plugins.build("zenpark.laws", experiment.formation.law),
        trigger=plugins.build("zenpark.triggers", experiment.trigger),
        clamp=experiment.formation.clamp,
        tracking_gain=experiment.formation.tracking_gain,
        legs=legs,
        limits=limits(experiment),
        body_hz=rates.body_hz,
        pose_every=round(rates.body_hz / rates.pose_hz),
        decide_every=round(rates.body_hz / rates.coordination_hz),
        duration=experiment.duration_s,
        patience_s=experiment.start.deadline_s if experiment.start.missing == "go-on" else None,
    )


def disturbance(experiment: Experiment, name: str) -> Disturbance:
    """What nature adds to a robot: `all`, overridden by its kind, overridden by its own name, field by field."""
    merged: dict[str, object] = {}
    for scope in ("all", experiment.robots[name].kind, name):
        if (given := experiment.disturbance.get(scope)) is not None:
            fields = msgspec.structs.asdict(given)
            merged.update({field: value for field, value in fields.items() if value is not None})
    return Disturbance(**merged)  # type: ignore[arg-type]


def request(
    experiment: Experiment, names: Sequence[str], seeds: Sequence[int], endpoints: Sequence[str] = ()
) -> BodyRequest:
    """What the bodies of `names` are opened with, one repetition for each seed; `endpoints` are the routers."""
    position, yaw = start(experiment, names)
    copies = len(seeds)
    return BodyRequest(
        names=tuple(names) * copies,
        kinds=kinds(experiment, names) * copies,
        addresses=tuple(experiment.robots[name].body for name in names) * copies,
        start=np.tile(position, (copies, 1)),
        yaw=np.tile(yaw, copies),
        rate_hz=experiment.rates.body_hz,
        seeds=tuple(seed for seed in seeds for _ in names),
        disturbance=tuple(disturbance(experiment, name) for name in names) * copies,
        external=tuple(experiment.robots[name].position == "external" for name in names) * copies,
        device=tuple(experiment.robots[name].device for name in names) * copies,
        endpoints=tuple(endpoints),
        keys=Keys(experiment.network.realm),
    )
