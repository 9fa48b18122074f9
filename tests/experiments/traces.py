"""Traces for tests: motions with known integrals, and a small simulated formation for figures and reports.

A formation is computed once in a process of tests; nobody writes to what they share.
"""

import dataclasses
from functools import cache

import numpy as np

from agents.network.messages import Event
from agents.plugins.laws import Distance
from experiments.arrays import PoseTable
from experiments.definition.experiment import Arena, LegTable, RobotTable
from experiments.definition.formation import law_offsets
from experiments.definition.graph import links
from experiments.definition.plan import Plan
from experiments.recording.trace import Trace
from tests.small import changed, reference, small
from twins.arrays import norm

STEP = 0.02
TIMED = ("position", "yaw", "true_position", "goal", "setpoint")


def parse_links(at_origin):
    """Every directed link: listener, speaker, distance [m], gain."""
    return [
        (link.receiver, link.sender, link.target.distance, link.target.gain) for link in Plan(at_origin).one_way_links
    ]


def at_origin(robots, formation, *, legs=(), **rest):
    """Robots by kind, all started at the origin; a leg of the first one at each of `legs`."""
    tables = {name: RobotTable(kind=kind, start=[0.0, 0.0]) for name, kind in robots.items()}
    timeline = [LegTable(at_s=at, robot=next(iter(robots)), plan="hold") for at in legs]
    fixed = {"source": "Nobody, Nowhere 2020", "duration_s": 45.0, "arena": Arena(size=(4.0, 4.0, 2.5))}
    return small(tables, formation, timeline=timeline, **{**fixed, **rest})


def trace(what, position, *, step=STEP, sent=None, delay=0.0, case="only", seed=1, events=(), planned=None):
    """A trace of given positions (T, N, 3), of a run of this or the `planned` length [s]; who `sent` when is heard."""
    names, count = tuple(what.robots), len(position)
    rows, none = len(names), np.zeros(len(names), dtype=np.intp)
    plan = Plan(changed(what, duration_s=max(count - 1, 1) * step if planned is None else planned))
    row = {name: i for i, name in enumerate(names)}
    sends = sorted((at, row[name], k) for name, times in (sent or {}).items() for k, at in enumerate(times, start=1))
    when = np.array([at for at, _, _ in sends])
    who = np.array([i for _, i, _ in sends], dtype=np.intp)
    number = np.array([k for _, _, k in sends], dtype=np.intp)
    place = position[np.clip(np.round(when / step).astype(int), 0, count - 1), who].reshape(-1, 3)
    still = np.zeros_like(place)
    pairs = [(k, link) for k, j in enumerate(who) for link in np.flatnonzero(plan.pose_links.sender == j)]
    take, link = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return Trace(
        case=case,
        plan=plan,
        seed=seed,
        robots=names,
        clock="virtual",
        time=np.arange(count) * step,
        **dict.fromkeys(("position", "true_position", "goal"), position),
        yaw=np.zeros((count, rows)),
        setpoint=np.zeros((count, rows, 4)),
        sent=PoseTable(who, number, when, when, place, still, np.zeros(len(when)), np.full(len(when), 100)),
        received=PoseTable(link, number[take], when[take], when[take] + delay, place[take], still[take]),
        **dict.fromkeys(("lost", "missed_deadlines", "interventions", "avoided"), none),
        ticks=np.full(rows, count),
        decisions=np.full(rows, count // 5),
        events=tuple(events),
    )


def cut(whole, end):
    """The trace of the same run, interrupted."""
    count = int(np.searchsorted(whole.time, end + 1e-9))
    parts = {name: getattr(whole, name)[:count] for name in TIMED}
    return dataclasses.replace(
        whole,
        **parts,
        sent=whole.sent.take(whole.sent.stamp < end - 1e-9),
        received=whole.received.take(whole.received.arrival < end - 1e-9),
        time=whole.time[:count],
        events=(*whole.events, Event(end, "phase", "conductor", "landing (interrupted)")),
    )


def pair(distance, *, legs=(), target=1.0, **rest):
    """A leader at the origin and one follower whose distance over time is given; the follower should keep `target`."""
    position = np.zeros((len(distance), 2, 3))
    position[:, 1, 0] = distance
    what = at_origin({"L": "turtlebot3", "F": "khepera4"}, {"L > F": target}, legs=legs)
    return trace(what, position, **rest)


@cache
def park(case="periodic", threshold=0.0, *, seed=1, duration=45.0):
    """The reference formation with first-order robots; send-on-delta if there is a threshold [m]."""
    robots = reference("periodic").robots
    legs = [LegTable(at_s=21.0, robot="TB01", plan="hold")] if duration > 21.0 else []
    what = changed(reference("periodic"), source="Nobody, Nowhere 2020", timeline=legs)
    start = np.array([(*robot.start[:2], robot.hover or 0.0) for robot in robots.values()])
    return simulate(what, start, case, threshold, seed=seed, duration=duration)


@cache
def crowd(rows, case="periodic", threshold=0.0, *, seed=1, duration=20.0):
    """Any number of robots on a hemisphere, each linked to its nearest ones, starting off their places."""
    rng = np.random.default_rng(rows)
    height = np.linspace(0.15, 0.95, rows)
    angle = np.arange(rows) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height**2)
    place = 1.4 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    gap = norm(place[:, None] - place)
    near = {tuple(sorted((i, int(j)))) for i in range(rows) for j in np.argsort(gap[i])[1:5]}
    names = [f"CF{i + 1:02d}" for i in range(rows)]
    formation = {f"{names[i]} - {names[j]}": float(gap[i, j]) for i, j in near}
    what = at_origin(dict.fromkeys(names, "crazyflie"), formation, title=f"{rows} robots on a hemisphere")
    start = place + rng.normal(0.0, 0.15, place.shape) * [1.0, 1.0, 0.0]
    return simulate(what, start, case, threshold, seed=seed, duration=duration)


def simulate(what, start, case, threshold, *, seed, duration):
    """The distance law on first-order robots, decided at 10 Hz; what neighbours hold is what the trigger sent."""
    rng = np.random.default_rng(seed)
    names, rows = list(what.robots), len(what.robots)
    flies = np.array([what.robots[name].kind == "crazyflie" for name in names])
    row = {name: i for i, name in enumerate(names)}
    parsed = parse_links(what)
    net = links([(row[i], row[j]) for i, j, _, _ in parsed], [d for *_, d, _ in parsed], [3.0] * len(parsed))
    moves = np.isin(np.arange(rows), net.receiver)
    place, held, goal = start.copy(), start.copy(), start.copy()
    wobble = np.zeros((rows, 3))
    count = round(duration / STEP) + 1
    record = np.zeros((count, rows, 3))
    sent = {name: [] for name in names}
    for k in range(count):
        t = k * STEP
        seen = place + wobble
        record[k] = seen
        speaks = norm(seen - held) > (threshold if k and threshold else -1.0)
        held[speaks] = seen[speaks]
        for i in np.flatnonzero(speaks & (k < count - 1)):
            sent[names[i]].append(t)
        if k % 5 == 0:
            offset = law_offsets(Distance(), seen, held[net.sender], net)
            step = np.clip(offset, -0.1, 0.1) * [1.0, 1.0, 0.0]
            goal = np.where(moves[:, None], seen + step, place)
        place = place + STEP * 1.5 * (goal - seen) * moves[:, None]
        if what.timeline and what.timeline[0].at_s <= t < what.timeline[0].at_s + 5.0:
            place[0, 0] += 0.15 * STEP
        kick = rng.normal(0.0, 0.010 * np.sqrt(2.0 * STEP / 0.5), (rows, 2))
        wobble[:, :2] = np.where(flies[:, None], wobble[:, :2] * (1.0 - STEP / 0.5) + kick, 0.0)
    events = [Event(0.0, "start", "conductor", "all robots are ready")]
    events += [Event(leg.at_s, "phase", leg.robot, "begins to follow its plan") for leg in what.timeline]
    return trace(what, record, sent=sent, delay=0.001, case=case, seed=seed, events=events)


def link_errors(links, position):
    """|‖p_i − p_j‖ − d_ij| (..., E) [m] of positions (..., N, 3)."""
    offset = position[..., links.receiver, :] - position[..., links.sender, :]
    return np.abs(np.linalg.norm(offset, axis=-1) - links.distance)
