"""How fast worlds are, in virtual time and as a process with its network; and how safe encounters in them are."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from tools.bench.bench_figure import Figure, cpu

if TYPE_CHECKING:
    from agents.arrays import Array
    from experiments.definition.experiment import Experiment

TICKS: Final = 500
RUN_S: Final = 8.0
START_S: Final = 15.0
EACH: Final = 50  # encounters of each pair of kinds and each direction: a thousand in all
SPREAD: Final = 0.8  # [m] between robots on a grid


def world() -> Iterator[Figure]:
    """Engines in virtual time, and the twin service under load: 40 robots with all sensors, 200 without."""
    yield from _stepping()
    yield from _service()


def encounters() -> Iterator[Figure]:
    """A thousand random encounters with the barrier, with the potential, and with nothing."""
    from tools.bench.encounters import Outcome, random_pairs  # noqa: PLC0415

    free = 0.0
    for name in (None, "potential", "barrier"):
        found = Outcome.joined(list(random_pairs(name, EACH).values()))
        share = 100.0 * float(found.collided.mean())
        free = free or share
        count = len(found.gap)
        label = f"collisions in {count}, avoidance: {name or 'none'}"
        yield Figure("encounters", label, float(found.collided.sum()), "", share / free, "× none")
        gap = 100.0 * float(found.gap.min())
        yield Figure("encounters", f"closest in {count}, avoidance: {name or 'none'}", gap, "cm", gap / 5.0, "× margin")
        arrived = 100.0 * float(found.arrived.mean())
        yield Figure("encounters", f"arrived, avoidance: {name or 'none'}", arrived, "%", arrived / 100.0, "× all")


def crowd(count: int, engine: str, *, sensing: bool) -> Experiment:
    """Robots on a grid: TurtleBots and Kheperas by turns with their sensors, or every kind without."""
    from experiments.definition.experiment import Arena, Experiment, Robot, World  # noqa: PLC0415

    kinds = ("turtlebot3", "khepera4") if sensing else ("turtlebot3", "khepera4", "crazyflie", "tello")
    side = int(np.ceil(np.sqrt(count)))
    robots = {}
    for k in range(count):
        kind = kinds[k % len(kinds)]
        start = [SPREAD * (k % side - 0.5 * (side - 1)), SPREAD * (k // side - 0.5 * (side - 1)), (0.1 * k) % 6.0]
        hover = 0.5 if kind in ("crazyflie", "tello") else None
        own: list[str] | None = None if sensing else []
        robots[f"R{k:03}"] = Robot(kind=kind, start=start, body="world", hover=hover, sensors=own)
    size = SPREAD * (side + 1)
    return Experiment(
        title="crowd", robots=robots, duration_s=60.0, arena=Arena(size=(size, size, 2.0)), world=World(engine=engine)
    )


def _setpoints(experiment: Experiment) -> Array:
    """(n, 4) something to do for each: circles on the floor, a place in the air."""
    setpoint = np.zeros((len(experiment.robots), 4))
    for row, robot in enumerate(experiment.robots.values()):
        if robot.kind == "crazyflie":
            setpoint[row] = (*robot.start[:2], 0.5, 0.0)
        elif robot.kind != "tello":
            setpoint[row] = (0.1, 0.5, 0.0, 0.0)
    return setpoint


def _stepping() -> Iterator[Figure]:
    from experiments.definition import bodies  # noqa: PLC0415
    from experiments.file.document import load  # noqa: PLC0415
    from experiments.run import simulate  # noqa: PLC0415
    from twins.body import TwinBody  # noqa: PLC0415

    def stepped(experiment: Experiment, *, sensing: bool) -> float:
        """CPU time [s] of TICKS ticks of the bodies, robots under way."""
        names = tuple(experiment.robots)
        request = bodies.body_request(experiment, names, [1])
        body = TwinBody(request, bodies.shared_world(experiment, names, sensing=sensing))
        setpoint, everyone = _setpoints(experiment), np.arange(len(names))
        body.takeoff(everyone, np.full(len(names), 0.5))
        tick = 0

        def advance() -> None:
            nonlocal tick
            for _ in range(TICKS):
                tick += 1
                body.read(tick / experiment.rates.body_hz)
                body.command(setpoint)

        advance()
        return cpu(advance)

    reference = load("robotic-park").experiment
    for engine in ("point-mass", "pymunk"):
        read = load("robotic-park", f"world.engine={engine}")
        taken = stepped(read.cases()["event"], sensing=False)
        span = TICKS / reference.rates.body_hz
        yield Figure(
            "world", f"{engine}, reference experiment, bodies", span / taken, "× real time", span / taken / 50.0, "× 50"
        )
        simulate(read, cases=["event"])
        taken = cpu(lambda read=read: simulate(read, cases=["event"]), 3)  # type: ignore[misc]
        rate = reference.duration_s / taken
        yield Figure("world", f"{engine}, reference experiment, whole run", rate, "× real time", rate / 50.0, "× 50")
    for count, sensing in ((40, True), (200, False)):
        for engine in ("point-mass", "pymunk"):
            experiment = crowd(count, engine, sensing=sensing)
            rate = TICKS / experiment.rates.body_hz / stepped(experiment, sensing=sensing)
            what = "all sensors" if sensing else "no sensors"
            yield Figure("world", f"{engine}, {count} robots, {what}, bodies", rate, "× real time", rate, "× real time")


def _service() -> Iterator[Figure]:
    from agents.network.endpoints import free_endpoint  # noqa: PLC0415
    from experiments.file.document import write_json  # noqa: PLC0415
    from experiments.real_time.conductor.support import start_router  # noqa: PLC0415
    from experiments.real_time.hosts.launcher import Launcher  # noqa: PLC0415

    for count, sensing in ((40, True), (200, False)):
        experiment = crowd(count, "pymunk", sensing=sensing)
        with tempfile.TemporaryDirectory() as name, Launcher(Path(name) / "logs") as launcher:
            file = Path(name) / "crowd.json"
            file.write_bytes(write_json(experiment))
            endpoints = [free_endpoint()]
            start_router(launcher, endpoints)
            process = launcher.start(
                "world", "experiments.real_time.processes.world", str(file), "--connect", endpoints[0]
            )
            factors, share = _under_load(experiment, endpoints, process.handle.pid)
        what = f"service, {count} robots, {'all' if sensing else 'no'} sensors"
        slowest = min(factors)
        yield Figure("world", f"{what}, slowest second", slowest, "× real time", slowest, "× real time")
        yield Figure("world", f"{what}, CPU", 100.0 * share, "% of a core", share, "× a core")


def _under_load(experiment: Experiment, endpoints: Sequence[str], pid: int) -> tuple[list[float], float]:
    """Real-time factors of each second, and the share of a core, while every robot is driven at body_hz."""
    from agents.network import messages, pubsub  # noqa: PLC0415
    from agents.network import session as network  # noqa: PLC0415
    from agents.network.keys import Keys  # noqa: PLC0415

    keys = Keys(experiment.network.realm)
    setpoints = [tuple(row) for row in _setpoints(experiment).tolist()]
    names = list(experiment.robots)
    factors: list[float] = []
    over = threading.Event()
    with network.open_session(endpoints, name="load", wait_s=10.0) as session:
        reports = pubsub.pose_subscriber(session, keys.world)
        publishers = [pubsub.publisher(session, keys.setpoint(name), messages.JSON) for name in names]
        patience = time.monotonic() + START_S
        while not list(network.received(reports.handler)):
            if time.monotonic() > patience:
                raise RuntimeError(f"the world said nothing for {START_S:g} s")
            over.wait(0.05)
        for name, publisher in zip(names, publishers, strict=True):
            publisher.put(messages.encode(messages.Command(name, 1, time.time(), "takeoff", height=0.5)))
        begin, busy, seq = time.monotonic(), _used(pid), 1
        while (now := time.monotonic() - begin) < RUN_S:
            seq += 1
            for name, publisher, setpoint in zip(names, publishers, setpoints, strict=True):
                publisher.put(messages.encode(messages.Command(name, seq, time.time(), "drive", setpoint=setpoint)))
            for sample in network.received(reports.handler):
                state = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.WorldState)
                if now > 2.0:  # the first seconds belong to the start
                    factors.append(state.factor)
            over.wait(max(0.0, (seq - 1) / experiment.rates.body_hz - (time.monotonic() - begin)))
        return factors, (_used(pid) - busy) / (time.monotonic() - begin)


def _used(pid: int) -> float:
    """CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
