"""Compiled experiment: its choices as objects, its links and anchors as arrays; the source of every `Assignment`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import msgspec
import numpy as np

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS, Kind
from agents.body.limits import Limits
from agents.decision.assignment import Assignment
from agents.decision.neighbours import Incoming
from agents.formation.anchors import Anchor
from agents.formation.link import Link
from agents.plugins import files, registry
from agents.plugins.avoidance import Avoidance
from agents.plugins.law import Law
from agents.plugins.planners import Leg
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Periodic, Trigger
from agents.vectors import Vector
from experiments.definition.experiment import WORLD, Choice, Experiment, Hybrid, RobotTable
from experiments.definition.formation import Pattern, compile_anchors, linked
from experiments.definition.graph import Links, adjacency
from experiments.definition.links import OneWay, one_way_links
from twins.arrays import Index
from twins.engines.engine import EngineFactory
from twins.scene import Scene


def _name(choice: Choice) -> str:
    """Name of the plug-in of a choice."""
    return registry.split(choice)[0]


def _plain(choice: Choice) -> str:
    """The same for people: of a plug-in in a file without its digest."""
    return files.plain(_name(choice))


def finds_contacts(engine: Choice) -> bool:
    """Whether an engine finds contacts; not where a recording is read and that engine is not installed."""
    try:
        chosen = cast(type[EngineFactory], registry.struct(registry.ENGINES, _name(engine)))
    except (registry.PluginError, msgspec.ValidationError):
        return False
    return chosen.CONTACTS


def latest_s(robot: RobotTable) -> float:
    """Largest delay of positions from outside by which a robot flies on board [s]; infinity: by none."""
    kind = KINDS[robot.kind]
    flies = robot.position == "external" and registry.body_name(robot.body) in kind.own_bodies
    return kind.late_s if flies else math.inf


@dataclass(frozen=True)
class Plan:
    """An experiment, resolved on demand: each property is computed once, at its first use.

    A recording can thus be read where a plug-in is missing that its metrics do not need. Rows are the robots in the
    order of the file.

    Raises:
        PluginError: By each property that needs a plug-in, if that cannot be loaded.
        msgspec.ValidationError: Likewise, if its parameters are wrong; never for an experiment of `document.read`.
    """

    experiment: Experiment

    def __reduce__(self) -> tuple[type[Plan], tuple[Experiment]]:
        """Other processes get the experiment, and resolve it themselves."""
        return Plan, (self.experiment,)

    @classmethod
    def made(cls, **fields: Any) -> Plan:  # noqa: ANN401 - of an experiment
        """The plan of an experiment that stands in no file."""
        return cls(Experiment(**fields))

    @classmethod
    def decoded(cls, text: str | bytes) -> Plan:
        """The plan of an experiment in JSON; raises msgspec.DecodeError or msgspec.ValidationError for another text."""
        return cls(msgspec.json.decode(text, type=Experiment))

    def changed(self, **fields: Any) -> Plan:  # noqa: ANN401 - of an experiment
        """The plan of the experiment with other values of some fields."""
        return Plan(msgspec.structs.replace(self.experiment, **fields))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.experiment.robots)

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        return tuple(KINDS[robot.kind] for robot in self.experiment.robots.values())

    @property
    def law_name(self) -> str:
        return _plain(self.experiment.formation.law)

    @cached_property
    def law(self) -> Law:
        built: Law = registry.build(registry.LAWS, self.experiment.formation.law)
        return built

    @property
    def trigger_name(self) -> str:
        return _plain(self.experiment.trigger)

    @cached_property
    def trigger(self) -> Trigger:
        built: Trigger = registry.build(registry.TRIGGERS, self.experiment.trigger)
        return built

    @property
    def wakes(self) -> bool:
        """Whether poses of neighbours wake a robot's process: each costs CPU time, and timed triggers send many."""
        return not self.trigger.TIMED

    @property
    def update_name(self) -> str:
        """Empty without a control trigger."""
        return _plain(self.experiment.formation.update or "")

    @cached_property
    def update(self) -> Trigger | None:
        """The control trigger; None: the law is computed at every decision."""
        chosen = self.experiment.formation.update
        return None if chosen is None else registry.build(registry.TRIGGERS, chosen)

    @property
    def needs_prediction(self) -> bool:
        """Whether the trigger counts on neighbours that extrapolate."""
        return self.trigger.PREDICTION != Trigger.PREDICTION

    @cached_property
    def predictor(self) -> Predictor:
        """Extrapolation between two transmissions: as the experiment says, else as its trigger or its law needs it."""
        chosen = self.experiment.prediction
        if chosen is None:
            chosen = self.trigger.PREDICTION if self.needs_prediction else self.law.PREDICTION
        built: Predictor = registry.build(registry.PREDICTORS, chosen)
        return HOLD if built == HOLD else built

    @cached_property
    def avoidance(self) -> Avoidance | None:
        chosen = self.experiment.avoidance
        return None if chosen is None else registry.build(registry.AVOIDANCES, chosen)

    @property
    def engine_name(self) -> str:
        return _name(self.experiment.world.engine)

    @cached_property
    def engine(self) -> EngineFactory:
        built: EngineFactory = registry.build(registry.ENGINES, self.experiment.world.engine)
        return built

    @property
    def finds_contacts(self) -> bool:
        return finds_contacts(self.experiment.world.engine)

    @cached_property
    def legs_by_robot(self) -> dict[str, tuple[Leg, ...]]:
        found: dict[str, tuple[Leg, ...]] = {}
        for leg in self.experiment.timeline:
            planned = Leg(leg.at_s, registry.build(registry.PLANNERS, leg.plan))
            found[leg.robot] = (*found.get(leg.robot, ()), planned)
        return found

    @cached_property
    def one_way_links(self) -> tuple[OneWay, ...]:
        """Every link of the formation, by receiver, then sender."""
        return tuple(one_way_links(self.experiment, self.law))

    @cached_property
    def formation(self) -> Pattern:
        """The links with their changes and presence."""
        return Pattern.compiled(self.experiment, self.one_way_links)

    @cached_property
    def anchors(self) -> dict[str, tuple[Anchor, ...]]:
        """Anchors of each robot that has one."""
        return compile_anchors(self.experiment)

    @cached_property
    def anchors_by_row(self) -> list[tuple[int, Anchor]]:
        """Every anchor with the row of its robot, in the order of the rows."""
        return [(self._row[name], each) for name in self.names for each in self.anchors.get(name, ())]

    @property
    def links(self) -> Links:
        """Every link that the formation may have, with the targets of the beginning."""
        return self.formation.links

    @cached_property
    def avoidance_senders(self) -> dict[str, tuple[str, ...]]:
        """Senders of poses that a robot receives for its avoidance alone, by receiver.

        These are all robots that no law links, if it needs all; else neighbours of robots that the centre guides, which
        have no law of their own.
        """
        avoidance, centrally = self.avoidance, set(self.guided)
        if avoidance is None or not (avoidance.hears == "all" or centrally):
            return {}
        linked = {(link.receiver, link.sender) for link in self.one_way_links}
        direct = {(receiver, sender) for receiver, sender in linked if receiver not in centrally}
        return {
            receiver: tuple(
                sender
                for sender in self.names
                if sender != receiver
                and (receiver, sender) not in direct
                and (avoidance.hears == "all" or (receiver, sender) in linked)
            )
            for receiver in self.names
            if self.experiment.robots[receiver].avoids
        }

    @cached_property
    def hops(self) -> float:
        """Largest number of links from any robot to any other, D; infinite where there is no way."""
        hears = adjacency(self.links, len(self.names)) > 0
        reached = np.eye(len(self.names), dtype=bool)
        for hops in range(len(self.names)):
            if reached.all():
                return hops
            reached = reached | (hears @ reached)
        return math.inf

    def laplacian_eigenvalues(self, weight: Callable[[float, float], float]) -> list[complex]:
        """Eigenvalues of the Laplacian of the links (N).

        A link weighs `weight` of the numbers of neighbours of its receiver and of its sender.
        """
        matrix = adjacency(self.links, len(self.names))
        degree = matrix.sum(axis=1)
        for i, j in np.argwhere(matrix):
            matrix[i, j] = weight(float(degree[i]), float(degree[j]))
        values = np.linalg.eigvals(np.diag(matrix.sum(axis=1)) - matrix)
        return [complex(each) for each in values]

    @property
    def talk_period_s(self) -> float:
        """Shortest time between two steps of a law after both of which its robot may transmit [s]."""
        trigger = self.trigger
        period = trigger.period_s if isinstance(trigger, Periodic) else 0.0
        decides = 1.0 / self.experiment.rates.coordination_hz
        return max(decides, period, trigger.minimum_interval_s, trigger.evaluate_every_s)

    @cached_property
    def _links_to(self) -> dict[str, list[int]]:
        """Numbers of the links to each receiver."""
        found: dict[str, list[int]] = {}
        for number, link in enumerate(self.one_way_links):
            found.setdefault(link.receiver, []).append(number)
        return found

    @cached_property
    def starts(self) -> tuple[tuple[str, float, float, float], ...]:
        """Name of each robot, x and y where it begins [m], and its radius [m]."""
        rows = zip(self.names, self.start_poses()[0], self.kinds, strict=True)
        return tuple((name, x, y, kind.radius) for name, (x, y, _), kind in rows)

    @cached_property
    def pose_links(self) -> Links:
        """Every link on which robots receive poses, receiver by receiver, those that only avoidance needs last."""
        guided, row = set(self.guided), self._row
        given = self.formation.targets_at(0.0)
        targets, ends = list[Link](), list[tuple[int, int]]()
        for receiver in self.names:
            numbers = () if receiver in guided else self._links_to.get(receiver, ())
            seen = self.avoidance_senders.get(receiver, ())
            targets += [*(given[number] for number in numbers), *(Link() for _ in seen)]
            senders = [*(self.one_way_links[number].sender for number in numbers), *seen]
            ends += [(row[receiver], row[sender]) for sender in senders]
        return linked(targets, ends)

    @cached_property
    def guided(self) -> tuple[str, ...]:
        """Robots for which the central controller decides."""
        architecture = self.experiment.architecture
        if isinstance(architecture, Hybrid):
            return tuple(name for name in self.names if name in architecture.robots)
        return self.names if architecture == "centralised" else ()

    @cached_property
    def leaders(self) -> tuple[str, ...]:
        """The leader of the file, or every robot without neighbours and anchor (none, if that would be all)."""
        formation = self.experiment.formation
        if formation.leader is not None:
            return (formation.leader,)
        held = {link.receiver for link in self.one_way_links} | set(formation.anchors)
        free = tuple(name for name in self.names if name not in held)
        return free if len(free) < len(self.names) else ()

    @property
    def externally_measured(self) -> tuple[str, ...]:
        """Robots with positions published by motion capture.

        The world itself publishes positions of its robots, as two sources would contradict each other. With a simulated
        motion capture, which sees these robots as well, the world does not publish them.
        """
        capture, robots = self.experiment.capture, self.experiment.robots.items()
        simulated = capture is not None and capture.simulated
        measured = [(name, robot.body) for name, robot in robots if robot.position == "external"]
        return tuple(name for name, body in measured if simulated or body != WORLD)

    @property
    def uses_chance(self) -> bool:
        """Whether anything depends on the seed: starts, noise of twins, the modelled network."""
        experiment = self.experiment
        nature = [self.disturbance(name) for name in self.names]
        jitters = [each.hover_jitter.sigma for each in nature if each.hover_jitter is not None]
        noisy = any(jitters) or any(each.position_sigma or each.yaw_sigma or each.odometry_drift for each in nature)
        scattered = bool(experiment.start.scatter or experiment.start.scatter_yaw)
        channel, links = experiment.channel, experiment.channel.links.values()
        lossy = channel.loss or channel.jitter_s or any(each.loss or each.jitter_s for each in links)
        sees = experiment.avoidance is not None and experiment.world.sensor_noise > 0.0
        return bool(noisy or scattered or lossy or sees)

    def start_poses(self) -> tuple[list[Vector], list[float]]:
        """Positions on the floor [m] and yaws [rad] of the robots at the start, as the file has them."""
        given = [(*map(float, robot.start), 0.0)[:3] for robot in self.experiment.robots.values()]
        return [(x, y, 0.0) for x, y, _ in given], [yaw for _, _, yaw in given]

    @property
    def scene(self) -> Scene:
        """Obstacles and walls of the arena."""
        arena = self.experiment.arena
        moving = {name: each.plan for name, each in arena.obstacles.items() if each.plan is not None}
        plans = {name: registry.build(registry.PLANNERS, plan) for name, plan in moving.items()}
        return Scene.furnished(arena.size, arena.obstacles, plans, walled=arena.walls)

    def disturbance(self, name: str) -> Disturbance:
        """Disturbance of a robot: `all`, overridden by its kind, overridden by its own name, field by field."""
        merged: dict[str, object] = {}
        for scope in ("all", self.experiment.robots[name].kind, name):
            if (given := self.experiment.disturbance.get(scope)) is not None:
                fields = msgspec.structs.asdict(given)
                merged.update({field: value for field, value in fields.items() if value is not None})
        return Disturbance(**merged)  # type: ignore[arg-type]

    def rows(self, names: Sequence[str]) -> Index:
        return np.array([self.names.index(name) for name in names], dtype=np.intp)

    def limits(self, name: str) -> Limits:
        """Limits of a robot."""
        (x, y, z), safety = self.experiment.arena.size, self.experiment.safety
        hold_s = safety.land_without_position_s
        if self.experiment.robots[name].body == WORLD:  # cannot move without its world, and may wait
            hold_s = self.experiment.world.patience_s
        low, high = (-x / 2, -y / 2, 0.0), (x / 2, y / 2, z)
        late_s = latest_s(self.experiment.robots[name])
        return Limits(low=low, high=high, hold_s=hold_s, late_s=late_s, **msgspec.structs.asdict(safety))

    def assignment(self, name: str, *, centrally: bool = False) -> Assignment:
        """The part of a robot.

        Args:
            centrally: As the central controller has it: link targets, anchors and plan are those of a robot that it
                guides, and there are none for one that decides for itself.
        """
        experiment, guided = self.experiment, name in self.guided
        decides = guided == centrally  # decides for this robot, at this place
        rates, within = experiment.rates, experiment.safety.start_within
        row = self._row[name]
        patient = experiment.start.missing != "go-on"
        begin, scattered = experiment.robots[name].start, experiment.start.scatter_yaw > 0.0
        return Assignment(
            name=name,
            kind=self.kinds[row],
            hover=experiment.robots[name].hover or math.nan,
            neighbours=self._incoming(name, in_law=decides, avoidance=not centrally),
            law=self.law,
            trigger=self.trigger,
            predictor=self.predictor,
            update=self.update,
            clamp=experiment.formation.clamp,
            tracking_gain=experiment.formation.tracking_gain,
            legs=self.legs_by_robot.get(name, ()) if decides else (),
            anchors=self.anchors.get(name, ()) if decides else (),
            changes=self.formation.changes,
            limits=self.limits(name),
            avoidance=None if centrally else self.avoidance,
            avoids=experiment.robots[name].avoids,
            body_hz=rates.body_hz,
            pose_every=round(rates.body_hz / rates.pose_hz),
            decide_every=round(rates.body_hz / rates.coordination_hz),
            duration=experiment.duration_s,
            lands_at=experiment.robots[name].lands_at_s or math.inf,
            number=row,
            count=len(self.names),
            patience_s=None if patient else experiment.start.deadline_s,
            start=self.starts[row][1:3] if within else None,
            start_within=within + math.sqrt(2.0) * experiment.start.scatter,
            start_yaw=math.nan if scattered or len(begin) < 3 else begin[2],
            starts=self.starts if within and not experiment.start.scatter else (),
            guided=guided,
        )

    def _incoming(self, name: str, *, in_law: bool, avoidance: bool) -> tuple[Incoming, ...]:
        """Links on which a robot receives: those of its law, then those that only its avoidance needs."""
        robots, found = self.experiment.robots, list[Incoming]()
        for number in self._links_to.get(name, ()) if in_law else ():
            link = self.one_way_links[number]
            to, sender = link.target, link.sender
            row = self._row[sender]
            found.append(Incoming(
                row, sender, self.kinds[row], to.distance, to.gain, to.relative, to.bearing, to.wants, True,
                not robots[sender].standby, self.formation.targets[number],
                link.since, link.until, link.reach, link.release,
            ))  # fmt: skip
        for sender in self.avoidance_senders.get(name, ()) if avoidance else ():
            row, awaited = self._row[sender], not robots[sender].standby
            found.append(Incoming(row, sender, self.kinds[row], math.nan, in_law=False, awaited=awaited))
        return tuple(found)

    @cached_property
    def _row(self) -> dict[str, int]:
        return {name: number for number, name in enumerate(self.names)}
