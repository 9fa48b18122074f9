"""Compiled experiment: its choices as objects, its links and anchors as arrays; the source of every `Assignment`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from agents.arrays import Index, Mask
from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.decision.assignment import Assignment
from agents.formation.graph import Links, links
from agents.plugins import registry
from agents.plugins.avoidance import Avoidance
from agents.plugins.laws import Law
from agents.plugins.planners import Leg
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Trigger
from experiments.definition.bodies import VICON_TWIN, WORLD, disturbance, hover_heights, kinds, start_poses
from experiments.definition.experiment import Experiment, Hybrid
from experiments.definition.formation import FormationArrays, compile_anchors
from experiments.definition.links import OneWay, one_way_links


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

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.experiment.robots)

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        return kinds(self.experiment, self.names)

    @cached_property
    def law(self) -> Law:
        built: Law = registry.build(registry.LAWS, self.experiment.formation.law)
        return built

    @cached_property
    def trigger(self) -> Trigger:
        built: Trigger = registry.build(registry.TRIGGERS, self.experiment.trigger)
        return built

    @cached_property
    def update(self) -> Trigger | None:
        """The control trigger; None: the law is computed at every decision."""
        chosen = self.experiment.formation.update
        return None if chosen is None else registry.build(registry.TRIGGERS, chosen)

    @cached_property
    def predictor(self) -> Predictor:
        """Extrapolation between two transmissions: as the experiment says, else as its trigger needs it."""
        chosen = self.experiment.prediction
        if chosen is None:
            trigger = registry.struct(registry.TRIGGERS, registry.split(self.experiment.trigger)[0])
            chosen = getattr(trigger, "prediction", "hold")
        built: Predictor = registry.build(registry.PREDICTORS, chosen)
        return HOLD if built == HOLD else built

    @cached_property
    def avoidance(self) -> Avoidance | None:
        chosen = self.experiment.avoidance
        return None if chosen is None else registry.build(registry.AVOIDANCES, chosen)

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
    def formation(self) -> FormationArrays:
        """The links as arrays, with changes and presence."""
        return FormationArrays.compiled(self.experiment, self.one_way_links)

    @property
    def links(self) -> Links:
        """Every link that the formation may have, with the targets of the beginning."""
        return self.formation.links

    @cached_property
    def avoidance_links(self) -> Links:
        """Links that only avoidance needs: between all robots that no law links, if it needs all; else from neighbours.

        Robots that the centre guides have no law of their own.
        """
        avoidance, none, centrally = self.avoidance, links([], [], []), set(self.guided)
        if avoidance is None or not (avoidance.hears == "all" or centrally):
            return none
        linked = {(link.receiver, link.sender) for link in self.one_way_links}
        there = {(receiver, sender) for receiver, sender in linked if receiver not in centrally}
        robots = list(enumerate(self.names))
        listening = [(i, a) for i, a in robots if self.experiment.robots[a].avoids]
        pairs = [
            (i, j)
            for i, a in listening
            for j, b in robots
            if i != j and (a, b) not in there and (avoidance.hears == "all" or (a, b) in linked)
        ]
        return links(pairs, [1.0] * len(pairs), [1.0] * len(pairs)) if pairs else none

    @cached_property
    def pose_links(self) -> Links:
        """Every link on which robots receive poses: those for the formation, then those that only avoidance needs."""
        return self.formation.without_receivers(self.rows(self.guided)).links.append(self.avoidance_links)

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
        """Robots whose positions motion capture publishes.

        Where robots of the world are, the world itself publishes them, as two sources would contradict each other; but
        a simulated motion capture sees them, and then the world leaves it to that.
        """
        simulated = self.experiment.positioning == VICON_TWIN
        robots = self.experiment.robots.items()
        return tuple(
            name for name, robot in robots if robot.position == "external" and (simulated or robot.body != WORLD)
        )

    @property
    def uses_chance(self) -> bool:
        """Whether anything depends on the seed: starts, noise of twins, the modelled network."""
        experiment = self.experiment
        nature = [disturbance(experiment, name) for name in self.names]
        noisy = any(
            each.position_sigma
            or each.yaw_sigma
            or each.odometry_drift
            or (each.hover_jitter and each.hover_jitter.sigma)
            for each in nature
        )
        scattered = bool(experiment.start.scatter or experiment.start.scatter_yaw)
        channel, links = experiment.channel, experiment.channel.links.values()
        lossy = channel.loss or channel.jitter_s or any(each.loss or each.jitter_s for each in links)
        sees = experiment.avoidance is not None and experiment.world.sensor_noise > 0.0
        return bool(noisy or scattered or lossy or sees)

    def rows(self, names: Sequence[str]) -> Index:
        return np.array([self.names.index(name) for name in names], dtype=np.intp)

    def limits(self, names: Sequence[str], copies: int = 1) -> Limits:
        """Limits of robots `names`, repeated `copies` times."""
        x, y, z = self.experiment.arena.size
        return Limits(
            low=np.array([-x / 2, -y / 2, 0.0]),
            high=np.array([x / 2, y / 2, z]),
            hold_s=np.array([self._patience(name) for name in names] * copies),
            **msgspec.structs.asdict(self.experiment.safety),
        )

    def _patience(self, name: str) -> float:
        """Time for which a robot holds without a position [s]; without its world it cannot move, and may wait."""
        experiment = self.experiment
        return experiment.world.patience_s if experiment.robots[name].body == WORLD else experiment.safety.blind_s

    def assignment(self, names: Sequence[str] | None = None, copies: int = 1, *, centrally: bool = False) -> Assignment:
        """The part of some robots, or of all; with `copies`, all robots side by side for as many repetitions.

        Args:
            centrally: The part of the central controller: links, anchors and plans are those of robots that it guides.

        Raises:
            ValueError: If copies are asked for but not of all robots: their links would point nowhere.
        """
        experiment, all_names, guided = self.experiment, self.names, self.guided
        names = all_names if names is None else names
        if copies > 1 and tuple(names) != all_names:
            raise ValueError("only the whole experiment can be repeated")
        rows = self.rows(names)
        others = [name for name in all_names if (name in guided) != centrally]
        mine = [name for name in names if name not in others]
        formation = self.formation.without_receivers(self.rows(others)).to_receivers(rows)
        watched = links([], [], []) if centrally else self.avoidance_links.to_receivers(rows)
        anchors = compile_anchors(experiment, names, only=mine)
        only_watched = np.repeat([False, True], [len(formation.links), len(watched)])
        planned = [
            (row, self.legs_by_robot[name])
            for row, name in enumerate(names)
            if name in mine and name in self.legs_by_robot
        ]
        first_rows = np.arange(copies) * len(names)
        if len(watched):
            formation = formation.append(watched)
        if copies > 1:
            formation = formation.repeated(copies, len(names))
            anchors = None if anchors is None else anchors.repeated(copies, len(names))
        rates, within = experiment.rates, experiment.safety.start_within
        return Assignment(
            names=tuple(names) * copies,
            kinds=kinds(experiment, names) * copies,
            hover=np.tile(hover_heights(experiment, names), copies),
            robots=all_names * copies,
            links=formation.links,
            changes=formation.changes,
            presence=formation.presence,
            anchors=anchors,
            law=self.law,
            trigger=self.trigger,
            predictor=self.predictor,
            update=self.update,
            clamp=experiment.formation.clamp,
            tracking_gain=experiment.formation.tracking_gain,
            legs=tuple((row + first_rows, own) for row, own in planned),
            limits=self.limits(names, copies),
            avoidance=None if centrally else self.avoidance,
            robot_kinds=self.kinds * copies,
            avoidance_only=np.tile(only_watched, copies) if len(watched) else None,
            avoids=np.array([experiment.robots[name].avoids for name in names] * copies),
            body_hz=rates.body_hz,
            pose_every=round(rates.body_hz / rates.pose_hz),
            decide_every=round(rates.body_hz / rates.coordination_hz),
            duration=experiment.duration_s,
            patience_s=experiment.start.deadline_s if experiment.start.missing == "go-on" else None,
            guided=np.array([name in guided for name in names] * copies) if guided else None,
            awaited=self._waited_for(formation.links, copies),
            start=np.tile(start_poses(experiment, names)[0][:, :2], (copies, 1)) if within else None,
            start_within=within + math.sqrt(2.0) * experiment.start.scatter,
            all_starts=start_poses(experiment, all_names)[0][:, :2]
            if within and not experiment.start.scatter
            else None,
        )

    def _waited_for(self, links: Links, copies: int) -> Mask | None:
        """Links (E,) from robots that are not on standby; None if no robot is."""
        standby = np.array([robot.standby for robot in self.experiment.robots.values()] * copies)
        return ~standby[links.sender] if standby.any() else None
