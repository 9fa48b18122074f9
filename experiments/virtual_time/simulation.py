"""The virtual clock: the whole experiment in one process, without sleeping, reproducible to the bit from its seed.

The decision is `agents.Agent` with all rows, the bodies are the twins, the network is
`experiments.virtual_time.network`; this file is only the loop. Several seeds run side by side as more rows, each with
the result that it would have alone (unless a lossy network makes one so much later ready that the others get their
orders at another multiple of `ORDERS_S`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from agents.agent import Agent
from agents.arrays import Array, Index, Mask, PoseTable, some
from agents.body.interface import BodyState
from agents.body.shadow_twin import shadowed
from agents.safety.hazards import Incident
from experiments.definition import bodies
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.virtual_time.conductor import VirtualConductor
from experiments.virtual_time.network import CentreLog, VirtualNetwork
from twins.body import TwinBody
from twins.engines.engine import Engine, Touch

STATE: Final = ("position", "velocity", "yaw", "true_position", "true_yaw")  # columns from the state of the bodies
OPTIONAL: Final = ("attitude", "shadow_position", "shadow_yaw")  # columns that exist in all samples or in none


@dataclass(frozen=True)
class Log:
    """Everything recorded of a virtual run; times since the common start [s], arrays over samples (K) and rows (R)."""

    names: tuple[str, ...]  # (N) robots of one repetition
    seeds: tuple[int, ...]  # one per repetition; R = N × repetitions, the rows of the first seed first
    lean: bool  # only `true_position`, and of poses only numbers and times, are kept
    time: Array  # (K,) at state_hz, from before take-off (negative) to the end
    phase: Index  # (K, R) `agents.decision.lifecycle.Phase`
    position: Array  # (K, R, 3) [m] measured
    velocity: Array  # (K, R, 3) [m/s] measured
    yaw: Array  # (K, R) [rad] measured
    true_position: Array  # (K, R, 3) [m]
    true_yaw: Array  # (K, R) [rad]
    goal: Array  # (K, R, 3) [m]
    setpoint: Array  # (K, R, 4)
    error: Array  # (K, R) [m]
    sent: PoseTable  # poses of all robots; `link` is the row
    received: PoseTable  # poses on all links, those of the first repetition first
    lost: Index  # (E,) samples lost on each link of all repetitions, from the common start to the landing
    decisions: int  # coordination decisions of each row
    updates: Index  # (R,) goals computed anew
    interventions: Index  # (R,) ticks on which safety changed the decision, from the common start on
    avoided: Index  # (R,) ticks on which avoidance changed the decision, from the common start on
    touches: tuple[Touch, ...]  # contacts, by their beginning
    ticks: int  # ticks from the common start to the end
    airborne: float  # [s] all robots were up (negative)
    ended: float  # [s] all robots were done
    attitude: Array | None  # (K, R, 4) unit quaternions w, x, y, z from robot to room; None if the engine has none
    obstacles: Array  # (K, repetitions, M, 3) x, y [m], yaw [rad] of each
    # (K, R, 3) of the twins beside the robots, NaN for rows without one; None if there is none
    shadow_position: Array | None
    shadow_yaw: Array | None  # (K, R) of those twins
    waited: Mask  # (repetitions,) that got an order later than alone, because another one was late
    centre: CentreLog | None = None  # None if each robot decides for itself
    incidents: tuple[Incident, ...] = ()  # hazards of robots


@dataclass(frozen=True)
class Instant:
    """Present state of a run in virtual time, for those who watch it; nothing in it may be changed."""

    time: float  # [s] since the common start; NaN before it is known
    now: float  # [s] of the clock of the decision
    agent: Agent
    state: BodyState
    engine: Engine  # of the bodies


def simulate(
    experiment: Experiment,
    seeds: Sequence[int],
    *,
    quiet: int = 0,
    lean: bool = False,
    landing: bool = True,
    progress: Callable[[float], object] = lambda _: None,
    watch: Callable[[Instant], object] = lambda _: None,
) -> Log:
    """Flies one case of an experiment once for each seed.

    Args:
        seeds: One for each repetition.
        quiet: Number of repetitions, the first ones, that are flown without noise.
        lean: Keep `true_position`, and of the poses sent numbers and times: a seventh of the memory, for sweeps. The
            other columns are empty, and so is the table of received poses.
        landing: Let the robots land; else the log ends with the run.
        progress: Called at state_hz with the time of the experiment [s]; NaN before its start is known.
        watch: Called at state_hz, and as slow as it likes.

    Raises:
        Stuck: If robots do not become ready, airborne or done.
    """
    names = tuple(experiment.robots)
    assignment = Plan(experiment).assignment(names, copies=len(seeds))
    agent = Agent(assignment)
    request = bodies.body_request(experiment, names, seeds, quiet=quiet)
    request = replace(request, external=(False,) * len(request.names))  # no motion capture in virtual time
    twin = TwinBody(request, bodies.shared_world(experiment, names, len(seeds)))
    body = shadowed(twin, request, bodies.shadow_periods(experiment, names, len(seeds)))
    network = VirtualNetwork(experiment, agent, seeds, lean=lean)
    rows = len(assignment.names)
    dt = 1.0 / assignment.body_hz
    log_every = round(assignment.body_hz / experiment.rates.state_hz)
    interventions, avoided = np.zeros(rows, dtype=np.intp), np.zeros(rows, dtype=np.intp)
    touches: list[Touch] = []
    samples: dict[str, list[Any]] = {}
    conductor = VirtualConductor(agent, names)
    nothing = np.zeros((rows, 0))
    tick = 0
    while not conductor.over:
        t = tick * dt
        state = body.read(t)
        sent = network.carry(t, state)
        actions = agent.act(t, state, sent)
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
            progress(t - conductor.start_at)
            watch(Instant(t - conductor.start_at, t, agent, state, twin.engine))
            sample = {
                **{what: getattr(state, what) for what in (*STATE, *OPTIONAL)},
                "phase": agent.lifecycle.phase.copy(),
                "goal": agent.goal,
                "setpoint": actions.setpoint,
                "error": agent.error,
                "obstacles": np.array(twin.engine.obstacles),
            }
            if lean:
                kept = {**dict.fromkeys(OPTIONAL), "true_position": state.true_position}
                sample = dict.fromkeys(sample, nothing) | kept
            for what, value in {**sample, "time": t}.items():
                samples.setdefault(what, []).append(value)
        if not landing and t - conductor.start_at >= experiment.duration_s - 0.5 * dt:
            break
        conductor.give_orders(t, dt)
        twin.begun_at = conductor.start_at
        tick += 1
    begin = conductor.start_at
    columns: dict[str, Any] = {what: None if each[0] is None else np.array(each) for what, each in samples.items()}
    columns["time"] = columns["time"] - begin
    return Log(
        names=names,
        seeds=tuple(seeds),
        lean=lean,
        decisions=agent.decisions,
        updates=agent.updates,
        interventions=interventions,
        avoided=avoided,
        touches=tuple(replace(touch, time=touch.time - begin) for touch in touches),
        ticks=round(experiment.duration_s / dt),
        airborne=conductor.airborne_at - begin,
        ended=tick * dt - begin,
        waited=conductor.waited,
        incidents=tuple(each._replace(time=each.time - begin) for each in agent.hazards.incidents),
        **network.logged(begin),
        **columns,
    )
