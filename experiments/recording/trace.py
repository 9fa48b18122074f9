"""Trace of one case of a run, as arrays; made by the virtual clock, or read back from a recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal, TypeVar

import msgspec
import numpy as np

from agents.network import messages
from agents.network.messages import Contact, Event, WorldState
from agents.safety.hazards import OVER, QUIET_S, UNRESOLVED, is_blind
from agents.ticks import ROUNDING_S
from experiments.arrays import PoseTable, data_frame
from experiments.definition.formation import counted_links, errors_over_time, robot_sums
from experiments.definition.plan import Plan, finds_contacts
from experiments.recording.clocks import ClockOffset
from twins.arrays import Array, Index, Mask

EPOCH: Final = 1_700_000_000.0  # UTC [s] of the common start in virtual time: any, but the same in every run
OPTIONAL: Final = ("attitude", "shadow_position", "shadow_yaw")  # columns that are left out where nothing is known

M = TypeVar("M", Contact, WorldState)


def world_in_run(
    contacts: Iterable[Contact], world: Iterable[WorldState], start: float, duration: float
) -> tuple[tuple[Contact, ...] | None, tuple[WorldState, ...]]:
    """Contacts and reports of the world in a run that began at `start` [s], which stamps count from.

    Contacts are None if there are none and no engine of the run finds contacts.
    """
    touched, reports = _messages_in_run(contacts, start, duration), _messages_in_run(world, start, duration)
    watched = bool(touched) or any(finds_contacts(engine) for engine in {report.engine for report in reports})
    return touched if watched else None, reports


def _messages_in_run(sent: Iterable[M], start: float, duration: float) -> tuple[M, ...]:
    """Messages of the run, in order of time."""
    kept = [
        msgspec.structs.replace(each, stamp=max(each.stamp - start, 0.0))
        for each in sent
        if -ROUNDING_S <= each.stamp - start <= duration + ROUNDING_S
    ]
    return tuple(sorted(kept, key=lambda each: each.stamp))


@dataclass(frozen=True)
class Goals:
    """Goals of one case, from the common start on.

    The delay of a robot begins with the measurement of its pose. It ends when the robot acts on the first goal computed
    from that pose: both ways through the network, and the wait for the next decision. Goals from a pose that was
    answered before (a robot with nothing new to transmit) have none.
    """

    sent: PoseTable  # goals in the place of positions; `link` is the row of the robot
    reached: Index  # (N,) goals that reached each robot
    acted: Array  # (A,) [s] since the common start, when a first answer was acted on
    follower: Index  # (A,) row of its robot
    delay: Array  # (A,) [s], see above
    received: Index  # (N,) poses of each robot that the central controller received
    lost: Index  # (N,) poses of each robot that never came, by their numbers
    dropped: Index  # (N,) poses of each robot that the modelled network dropped
    reports: tuple[messages.CentreState, ...] = ()  # stamps since the common start; none in virtual time

    @classmethod
    def of_run(
        cls,
        sent: PoseTable,
        receipts: PoseTable,
        duration: float,
        *,
        received: Index,
        lost: Index,
        dropped: Index,
        reports: tuple[messages.CentreState, ...] = (),
    ) -> Goals:
        """The goals of a run of `duration` [s], with times since the common start.

        Args:
            receipts: Goals that robots acted on: their row, when (`arrival`), and the stamp of the pose on which the
                goal rests (`extra`).
        """
        assert receipts.extra is not None
        acted, row = receipts.arrival, receipts.link
        pose = receipts.extra[:, 0]
        reached, first = in_run(acted, duration), _first_of_pose(acted, row, pose)
        first &= reached
        return cls(
            sent=sent.take(in_run(sent.stamp, duration)),
            reached=np.bincount(row[reached], minlength=len(received)),
            acted=acted[first],
            follower=row[first],
            delay=(acted - pose)[first],
            received=received,
            lost=lost,
            dropped=dropped,
            reports=reports,
        )


def _first_of_pose(time: Array, row: Index, pose: Array) -> Mask:
    """Mask of the goals (K,), acted on at `time`, that are the first of their robot to rest on that pose."""
    order = np.lexsort((time, row))
    changed = np.ones(len(order), dtype=bool)
    changed[1:] = (np.diff(row[order]) != 0) | (np.diff(pose[order]) > ROUNDING_S)
    first = np.zeros(len(order), dtype=bool)
    first[order] = changed
    return first


def in_run(time: Array, duration: float) -> Mask:
    """The end belongs to the landing: 50 Hz for 45 s are 2250 messages."""
    return np.asarray((time >= -ROUNDING_S) & (time < duration - ROUNDING_S))


def poses_in_run(table: PoseTable, duration: float, by: Literal["stamp", "arrival"]) -> PoseTable:
    """Poses that were sent (`stamp`) or received (`arrival`) in a run of `duration` [s], in order of that time."""
    times = np.maximum(getattr(table, by), 0.0)
    which = np.flatnonzero(in_run(getattr(table, by), duration))
    which = which[np.argsort(times[which], kind="stable")]
    whole = len(which) > 0 and (np.diff(which) == 1).all()  # no copy then: of many robots it is large
    kept = table.take(slice(which[0], which[-1] + 1) if whole else which)
    return msgspec.structs.replace(kept, **{by: np.maximum(getattr(kept, by), 0.0)})


@dataclass(frozen=True, eq=False)
class Trace:
    """Trace of a case. Arrays over samples (T) and robots (N); times since the common start [s]."""

    case: str
    plan: Plan  # plan of this case, overrides applied
    seed: int
    robots: tuple[str, ...]  # names, in the order of the rows
    clock: str  # "real" or "virtual"
    time: Array  # (T,) [s] common, uniform grid
    position: Array  # (T, N, 3) [m] measured
    yaw: Array  # (T, N) [rad] measured
    true_position: Array  # (T, N, 3) [m] of twins, else as measured
    goal: Array  # (T, N, 3) [m]
    setpoint: Array  # (T, N, 4) as sent to the body, see `agents.network.messages.State`
    sent: PoseTable  # poses sent by the robots, ordered by time; `link` is the row of the sender
    received: PoseTable  # poses ordered by arrival; `link` is one of `plan.pose_links`
    lost: Index  # (N,) poses of each robot that by their numbers were sent but not received, or not recorded
    missed_deadlines: Index  # (N,) ticks that began more than one period late
    ticks: Index  # (N,)
    decisions: Index  # (N,) recomputed goals
    events: tuple[Event, ...]
    interventions: Index  # (N,) ticks on which safety changed the decision
    avoided: Index  # (N,) ticks on which avoidance changed the decision
    contacts: tuple[Contact, ...] | None = None  # None: no world, or its engine finds no contacts
    world: tuple[WorldState, ...] = ()
    attitude: Array | None = None  # (T, N, 4) unit quaternions w, x, y, z from robot to room, NaN where unknown
    shadow_position: Array | None = None  # (T, N, 3) [m] of the twins beside robots, NaN for robots without one
    shadow_yaw: Array | None = None  # (T, N) [rad] of those twins
    dropped: Index | None = None  # (E,) by the modelled network on each of `plan.pose_links`; None if unknown
    foreign: Index | None = None  # (N,) poses in the name of each robot, refused: not from its process; None if unknown
    goals: Goals | None = None  # goals of the central controller; None if each robot decides for itself
    clocks: tuple[ClockOffset, ...] = ()  # offsets of the other machines; stamps made there are corrected
    # of laws that remember, by name: variables (T, N, k), and measures (T, N), NaN where unknown
    memory: Mapping[str, Array] = field(default_factory=dict)
    measures: Mapping[str, Array] = field(default_factory=dict)
    joined: Array | None = None  # (N,) [s] since when each robot takes part; None: all from the start

    @cached_property
    def blind(self) -> Mask:
        """(T, N) samples at which a robot had lost its own position, by its hazards: its body may repeat an old one."""
        blind = np.zeros((len(self.time), len(self.robots)), dtype=bool)
        for event in self.events:
            lost = event.kind == "lost"  # its process ended: there are no more positions, or those of the next one
            if event.source not in self.robots or not (lost or (event.kind == "hazard" and is_blind(event.text))):
                continue
            since = event.stamp - QUIET_S if not lost and event.text.startswith(OVER) else event.stamp
            begins = not (lost or event.text.startswith((OVER, UNRESOLVED)))
            blind[self.time >= since, self.robots.index(event.source)] = begins
        return blind

    @cached_property
    def link_errors(self) -> Array:
        """Errors (T, E) [m] of links on true positions, see `formation.errors_over_time`; NaN of blind robots."""
        blind, place = self.blind, self.true_position
        place = np.where(blind[:, :, None], np.nan, place) if blind.any() else place
        return errors_over_time(self.plan.law, self.plan.formation, self.time, place)

    def columns(self) -> dict[str, Array]:
        """Time series of the robots by name, each (T, N): places [m], yaw [rad], error [m], what the law remembers."""
        places = {"": self.position, "true_": self.true_position, "goal_": self.goal}
        found = {f"{what}{axis}": each[..., k] for what, each in places.items() for k, axis in enumerate("xyz")}
        found["yaw"] = self.yaw
        found["error"] = robot_sums(
            self.link_errors, counted_links(self.plan.law, self.plan.formation, len(self.robots))
        )
        for name, values in self.memory.items():
            size = values.shape[2]
            parts = {f"memory_{name}[{k}]" if size > 1 else f"memory_{name}": values[..., k] for k in range(size)}
            found |= parts
        return found | {f"measure_{name}": values for name, values in self.measures.items()}

    def to_frame(self) -> Any:  # noqa: ANN401 - of pandas or of polars
        """Time series as a data frame of pandas, or of polars where only that is installed: a row per time and robot.

        Columns are case, time [s], robot, and `columns`, as `./zenpark export --csv` writes them; an unknown number is
        NaN, in polars null. Raises ImportError if neither is installed.
        """
        rows, count = len(self.time), len(self.robots)
        heads = {
            "case": [self.case] * (rows * count),
            "time": np.repeat(self.time, count),
            "robot": [*self.robots] * rows,
        }
        return data_frame(heads | {name: values.ravel() for name, values in self.columns().items()})

    @cached_property
    def sent_at(self) -> list[Array]:
        """Stamps of the poses that each robot sent [s], in their order."""
        return [self.sent.stamp[which] for which in self.sent_rows]

    @cached_property
    def sent_rows(self) -> list[Index]:
        """Rows of the poses of each robot in `sent`, in their order."""
        order = np.argsort(self.sent.link, kind="stable")
        return np.split(order, np.searchsorted(self.sent.link[order], np.arange(1, len(self.robots))))
