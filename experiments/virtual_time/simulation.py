"""The virtual clock: the whole experiment in one process, without sleeping, reproducible to the bit from its seed.

The decision is `agents.Agent` with all rows, the bodies are the twins, the network is
`experiments.virtual_time.network`; this file is only the loop. Several seeds run side by side as more rows, each with
the result that it would have alone (unless a lossy network makes one so much later ready that the others get their
orders at another multiple of `ORDERS_S`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agents.agent import Agent
from agents.arrays import Array, Index, Mask, PoseTable, some
from agents.body.interface import BodyState
from agents.body.shadow_twin import shadowed
from agents.decision.lifecycle import Phase
from agents.safety.hazards import Incident
from experiments.definition import bodies
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.virtual_time.network import Steered, VirtualNetwork
from twins.body import TwinBody
from twins.engines.engine import Touch

LEAD_S = 0.5  # from the order to the common start
ORDERS_S = 0.5  # orders before the start fall on multiples of this, so that repetitions a few ticks apart get the same
ROUNDING_S = 1e-9  # ticks are multiples of a period that binary fractions miss by less than this
PATIENCE_S = 60.0  # an experiment whose robots are not ready, up or down after this long never will be


class Stuck(RuntimeError):
    """Robots that do not become ready, airborne or done."""


@dataclass(frozen=True)
class Log:
    """What happened, in the time of the experiment [s]; arrays over samples (K) and rows (R).

    Attributes:
        names: Of the rows of one repetition (N).
        seeds: One for each repetition; R = N × repetitions, the rows of the first seed first.
        lean: Only `true_position`, and of poses only numbers and times, are kept.
        time: (K,) at state_hz, from before take-off (negative) to the end.
        phase: (K, R) `agents.decision.lifecycle.Phase`.
        position: (K, R, 3), `velocity` (K, R, 3), `yaw` (K, R): measured.
        true_position: (K, R, 3), `true_yaw` (K, R).
        goal: (K, R, 3), `setpoint` (K, R, 4), `error` (K, R).
        sent: Poses of all robots; `link` is the row.
        received: Poses on all links, those of the first repetition first.
        lost: (E,) samples lost on each link of all repetitions, from the common start to the landing.
        decisions: Coordination decisions of each row.
        updates: (R,) of these, those at which the row computed its goal anew.
        interventions: (R,) ticks on which safety changed what was decided, from the common start on.
        avoided: (R,) ticks on which avoidance did, from the common start on.
        touches: Contacts that began, at times since the common start.
        ticks: Ticks from the common start to the end.
        airborne: When all robots were up (negative), and `ended` when all were done.
        ended: See `airborne`.
        attitude: (K, R, 4) unit quaternions w, x, y, z from robot to room; None if the engine has none.
        obstacles: (K, repetitions, M, 3) x, y [m], yaw [rad] of each.
        shadow_position: (K, R, 3) of the twins beside the robots, NaN for rows without one; None if there is none.
        shadow_yaw: (K, R) of those twins.
        waited: (repetitions,) that got an order later than they would have got it alone, because another one was late.
        steered: What went between the robots and the centre; None if every robot decides for itself.
        incidents: What was wrong with robots, at times since the common start.
    """

    names: tuple[str, ...]
    seeds: tuple[int, ...]
    lean: bool
    time: Array
    phase: Index
    position: Array
    velocity: Array
    yaw: Array
    true_position: Array
    true_yaw: Array
    goal: Array
    setpoint: Array
    error: Array
    sent: PoseTable
    received: PoseTable
    lost: Index
    decisions: int
    updates: Index
    interventions: Index
    avoided: Index
    touches: tuple[Touch, ...]
    ticks: int
    airborne: float
    ended: float
    attitude: Array | None
    obstacles: Array
    shadow_position: Array | None
    shadow_yaw: Array | None
    waited: Mask
    steered: Steered | None = None
    incidents: tuple[Incident, ...] = ()


class _Samples:
    """Rows of a log while it grows."""

    def __init__(self) -> None:
        self._columns: list[tuple[Any, ...]] = []

    def add(self, *values: Array | Index | float) -> None:
        self._columns.append(values)

    def stacked(self) -> tuple[Any, ...]:
        """As arrays with the samples as first axis."""
        return tuple(np.array(column) for column in zip(*self._columns, strict=True))


def simulate(
    experiment: Experiment,
    seeds: Sequence[int],
    *,
    lean: bool = False,
    landing: bool = True,
    tell: Callable[[float], object] = lambda _: None,
) -> Log:
    """Flies one case of an experiment once for each seed.

    Args:
        experiment: The case.
        seeds: One for each repetition.
        lean: Keep `true_position` and who sent when, and nothing of the other columns: a seventh of the memory, for
            sweeps. They are empty, and so is everything that was heard.
        landing: Let the robots land; else the log ends with the run.
        tell: Called at state_hz with how far it is, in the time of the experiment [s]; NaN before its start is known.

    Raises:
        Stuck: If robots do not become ready, airborne or done.
    """
    names = tuple(experiment.robots)
    assignment = Plan(experiment).assignment(names, copies=len(seeds))
    agent = Agent(assignment)
    request = bodies.request(experiment, names, seeds)
    request = replace(request, external=(False,) * len(request.names))  # nobody measures in virtual time
    twin = TwinBody(request, bodies.world(experiment, names, len(seeds)))
    body = shadowed(twin, request, bodies.shadows(experiment, names, len(seeds)))
    network = VirtualNetwork(experiment, agent, seeds, lean=lean)
    rows = len(assignment.names)
    dt = 1.0 / assignment.body_hz
    log_every = round(assignment.body_hz / experiment.rates.state_hz)
    interventions, avoided = np.zeros(rows, dtype=np.intp), np.zeros(rows, dtype=np.intp)
    touches: list[Touch] = []
    states, seen = _Samples(), _Samples()
    conductor = _Conductor(agent, names)
    nothing = np.zeros((rows, 0))
    blank = (nothing,) * 4
    tick = 0
    while not conductor.over:
        t = tick * dt
        state = body.read(t)
        said = network.carry(t, state)
        actions = agent.act(t, state, said)
        if actions.commands is not None:
            body.takeoff(actions.commands.takeoff, assignment.hover[actions.commands.takeoff])
            body.land(actions.commands.land)
            body.stop(actions.commands.stop)
        body.command(actions.setpoint)
        if agent.decisions:
            if some(actions.changed):
                interventions += actions.changed
            if some(actions.avoided):
                avoided += actions.avoided
        touches += twin.touches()
        if (agent.tick - 1) % log_every == 0:  # the agent's count begins anew at the common start
            tell(t - conductor.start_at)
            whole = (agent.lifecycle.phase.copy(), *_measured(state), agent.goal, actions.setpoint, agent.error)
            states.add(t, *((*blank, state.true_position, *blank) if lean else whole))
            more = () if lean else tuple(value for value in _extra(state) if value is not None)
            seen.add(nothing if lean else np.array(twin.engine.obstacles), *more)
        if not landing and t - conductor.start_at >= experiment.duration_s - 0.5 * dt:
            break
        conductor.look(t, dt)
        twin.begun_at = conductor.start_at
        tick += 1
    begin = conductor.start_at
    time, phase, position, velocity, yaw, true_position, true_yaw, goal, setpoint, error = states.stacked()
    obstacles, *rest = seen.stacked()
    extra = [None if lean or value is None else rest.pop(0) for value in _extra(state)]
    return Log(
        names=names,
        seeds=tuple(seeds),
        lean=lean,
        time=time - begin,
        phase=phase.astype(np.intp),
        position=position,
        velocity=velocity,
        yaw=yaw,
        true_position=true_position,
        true_yaw=true_yaw,
        goal=goal,
        setpoint=setpoint,
        error=error,
        sent=network.sent(begin),
        received=network.received(begin),
        lost=network.lost,
        decisions=agent.decisions,
        updates=agent.updates,
        interventions=interventions,
        avoided=avoided,
        touches=tuple(replace(touch, time=touch.time - begin) for touch in touches),
        ticks=round(experiment.duration_s / dt),
        airborne=conductor.airborne_at - begin,
        ended=tick * dt - begin,
        attitude=extra[0],
        obstacles=obstacles,
        shadow_position=extra[1],
        shadow_yaw=extra[2],
        waited=conductor.waited,
        steered=network.steered(begin),
        incidents=tuple(each._replace(time=each.time - begin) for each in agent.hazards.incidents),
    )


def _measured(state: BodyState) -> tuple[Array, ...]:
    return state.position, state.velocity, state.yaw, state.true_position, state.true_yaw


def _extra(state: BodyState) -> tuple[Array | None, ...]:
    """What there is of in all samples or in none."""
    return state.attitude, state.shadow_position, state.shadow_yaw


class _Conductor:
    """Gives the orders that the conductor of a real run gives, at the same moments of the robots' lives."""

    def __init__(self, agent: Agent, names: tuple[str, ...]) -> None:
        self._agent, self._names = agent, names
        self._stage = Phase.READY
        self._since = 0.0
        self.airborne_at = self.start_at = np.nan
        self.waited: Mask = np.zeros(len(agent.lifecycle.phase) // len(names), dtype=bool)
        self.over = False

    def look(self, t: float, dt: float) -> None:
        """After each tick."""
        if self._agent.lifecycle.all_running:
            return
        phase = self._agent.lifecycle.phase
        if self._stage == Phase.RUNNING:
            if phase.min() >= Phase.LANDING:
                self._since, self._stage = t, Phase.DONE
            return
        orders = not round(t / dt) % max(1, round(ORDERS_S / dt))
        if phase.min() < self._stage:
            if orders and self._stage < Phase.RUNNING:
                self.waited |= phase.reshape(len(self.waited), -1).min(axis=1) >= self._stage
            if t - self._since > PATIENCE_S:
                late = np.flatnonzero(phase < self._stage)[: len(self._names)]
                names = ", ".join(sorted({self._names[row % len(self._names)] for row in late}))
                reason = self._agent.lifecycle.reason[late[0]]
                raise Stuck(f"not {self._stage.word} after {PATIENCE_S:g} s: {names} ({reason})")
            return
        if self._stage < Phase.RUNNING and not orders:
            return
        self._since = t
        life = self._agent.lifecycle
        if self._stage == Phase.READY:
            for row in range(len(phase)):
                life.takeoff(row)
            self._stage = Phase.AIRBORNE
        elif self._stage == Phase.AIRBORNE:
            self.airborne_at = t
            self.start_at = t + round(LEAD_S / dt) * dt
            for row in np.flatnonzero(phase == Phase.AIRBORNE).tolist():
                life.start(row, self.start_at)
            self._stage = Phase.RUNNING
        else:
            self.over = True
