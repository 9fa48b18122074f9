"""The seam between the product and the simulation: the functions that are replaced, and those that are watched.

The process that calls `patch` can never go back. It replaces clocks, threads, signals, pipes, disks and Zenoh by those
of `tests.simulated.kernel`, `network` and `processes`.
"""

from __future__ import annotations

import builtins
import functools
import io
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import typer
import zenoh

import agents.clock
import agents.runtime.router as router_process
from agents.network import messages, name_ownership, pubsub
from agents.network import session as network_session
from agents.plugins import calls, registry
from agents.runtime import command_line, lifeline, loop, telemetry
from agents.safety.hazards import Hazards
from experiments.file import document
from experiments.real_time.conductor import conduct, orders, run_view
from experiments.real_time.conductor import conductor as conducting
from experiments.real_time.hosts import launcher, run_registry
from experiments.real_time.processes import robot as robot_process
from experiments.real_time.processes import world_population
from experiments.recording import version, writer
from tests.simulated import advanced, bodies, links, processes
from tests.simulated import kernel as sim
from tests.simulated.world import current, running
from tools import main as command
from tools import progress as shown_progress
from tools.commands import run as run_command

MADE = version.provenance("")  # asks git, with a real duration


def patch() -> None:
    """Replace clocks, threads, signals, disks, pipes and the network of this process by simulated ones, for good."""
    os.environ.pop("ZENPARK_CLOCK", None)
    product = [module for name, module in sys.modules.items() if name.startswith(("agents.", "experiments.", "tools."))]
    names = [{*vars(module)} for module in product]
    _share()
    _patch_clocks_and_threads()
    _patch_processes()
    _patch_network()
    _watch_product()
    unknown = [{*vars(module)} - before for module, before in zip(product, names, strict=True)]
    assert not any(unknown), f"the product has none of these names: {set().union(*unknown)}"


def _share() -> None:
    """Let all processes share what each real one builds for itself, from the same text and the same classes."""
    typer.main.get_command = functools.cache(typer.main.get_command)
    command.part_for = lambda *_: command.app  # the whole application, which is built once
    command_line.parser_of = functools.cache(command_line.parser_of)
    registry._fault_of = functools.cache(registry._fault_of)
    read = functools.cache(document._document)
    document._document = lambda file, label, text, flags, **more: read(file, label, text, tuple(flags), **more)


def _patch_clocks_and_threads() -> None:
    version.provenance = lambda *_: MADE
    version.load = lambda: None
    secrets.token_hex = lambda count: sim.current().rng.randbytes(count).hex()
    time.monotonic = time.perf_counter = sim.monotonic
    time.time, time.sleep = sim.wall, sim.sleep
    time.monotonic_ns = lambda: int(1e9 * sim.monotonic())
    time.clock_gettime = sim.monotonic
    time.process_time = lambda: 0.0
    telemetry.resident_mb = lambda: 0.0
    threading.Event, threading.Lock, threading.Thread = sim.Event, sim.Lock, sim.Thread
    threading.enumerate = lambda: []
    lifeline.LifelineEnd = sim.LifelineEnd
    command_line.spare_imports = lambda: None
    calls.signal = SimpleNamespace()  # plug-ins are not supervised without `setitimer`
    orders.ThreadPoolExecutor = processes.Pool


def _patch_processes() -> None:
    def die(code: int) -> None:
        sim.current().process.leave(code)

    def handle(number: int, handler: Any) -> Any:
        before = sim.current().process.handlers.get(int(number), signal.SIG_DFL)
        sim.current().process.handlers[int(number)] = handler
        return before

    def environment(key: str, default: str | None = None) -> str | None:
        return sim.current().process.env.get(key, default) if sim.current().process is not None else default

    def kill(pid: int, number: int) -> None:
        current().signal(next(each for each in sim.current().processes if each.pid == pid), number)

    agents.clock.os = SimpleNamespace(environ=SimpleNamespace(get=environment))
    os._exit, os.kill = die, kill
    os.getpid = lambda: processes.REAL.getpid() if (process := running()) is None else process.pid
    signal.signal = handle
    signal.getsignal = lambda number: sim.current().process.handlers.get(int(number), signal.SIG_DFL)
    signal.pthread_sigmask = lambda *_: set()
    sys.stdout = sys.stderr = processes.Output()
    command_line.detach = lambda: None
    launcher.Launcher.preload, launcher.Launcher.start = lambda _: None, processes.start
    conduct.free_endpoints = lambda count, protocol: [f"{protocol}/127.0.0.1:{7447 + k}" for k in range(count)]
    run_registry.registered, run_registry.tell = processes.registered, processes.tell
    run_registry.look = lambda: run_registry.Listing(
        [run for run, _, process in current().runs if not process.dead], [], []
    )
    run_registry.born = lambda pid: (
        "" if any(each.pid == pid and not each.dead for each in sim.current().processes) else None
    )
    run_registry.RegisteredRun._is_of_user = lambda _: True
    run_command.refused = lambda *_, **__: 0  # the check flies ideal runs, which the scripts do not need
    builtins.open = io.open = processes.open_file
    writer.TemporaryFile = processes.temporary_file


def _patch_network() -> None:
    pubsub.RingChannel = network_session.RingChannel = pubsub.FifoChannel = links.Ring
    pubsub.pose_publisher = lambda session, key, mime, kept=1: advanced.AdvancedPublisher(session, key, mime, kept)
    pubsub.advanced_subscriber = advanced.AdvancedSubscriber
    pubsub.Callback = name_ownership.Callback = lambda function, indirect: function
    zenoh.SourceInfo = links.SourceInfo
    network_session.open_with = lambda chosen: current().network.open(chosen)  # noqa: PLW0108 - of the world that comes
    network_session.forbid_lingering = router_process.forbid_lingering = lambda: 0
    network_session.hang_up = lambda session: session.hang_up()


def _watch_product() -> None:
    """Let the laboratory see what the product does."""
    _wrap(sim.Process, "exit", after=lambda process, _: current().note_end(process))
    shadowed = robot_process.shadowed
    robot_process.shadowed = lambda body, request, periods: bodies.WatchedBody(
        shadowed(body, request, periods), request.names, request.rate_hz
    )
    _wrap(loop.Runtime, "__init__", after=_note_runtime)
    _wrap(loop.Runtime, "tick", after=_note_phases)
    _wrap(Hazards, "_record", before=_count_hazards, after=_note_hazards)
    _wrap(loop.Runtime, "_send_pose", before=_note_pose)
    _wrap(world_population.WorldBodies, "__init__", after=_note_population)
    _wrap(conducting.CaseRun, "__init__", after=_note_case)
    _wrap(run_view.NetworkView, "receive_status", after=_note_status)
    _wrap(run_view.NetworkView, "report", after=_note_event)
    lines = shown_progress.Lines.__call__

    def show(self: Any, progress: run_view.Progress) -> None:
        lines(self, progress)
        world = current()
        world.progress = progress
        known = world.seen.get(id(progress), 0)
        if known < len(progress.events):
            world.seen[id(progress)] = len(progress.events)
            world.events += progress.events[known:]

    shown_progress.Lines.__call__ = show
    send = orders.send_order

    def send_order(session: Any, keys: Any, robots: Sequence[str], order: messages.Order, *more: Any) -> Any:
        if order.order == "takeoff":
            current().takeoffs_ordered.extend((current().now, robot) for robot in robots)
        return send(session, keys, robots, order, *more)

    orders.send_order = send_order
    _wrap(orders.Emergency, "receive", before=lambda *_, **__: current().stops.append(current().now))


def _wrap(
    kind: type, name: str, *, before: Callable[..., object] | None = None, after: Callable[..., object] | None = None
) -> None:
    """Call something with the arguments of a method before or after it."""
    method = getattr(kind, name)

    def wrapped(*given: Any, **more: Any) -> Any:
        if before is not None:
            before(*given, **more)
        result = method(*given, **more)
        if after is not None:
            after(*given, **more)
        return result

    setattr(kind, name, wrapped)


def _note_runtime(runtime: loop.Runtime, *_: object, **__: object) -> None:
    current().runtimes[sim.current().process.pid] = runtime


def _note_population(population: world_population.WorldBodies, *_: object, **__: object) -> None:
    current().populations.append((sim.current().process, population))


def _note_phases(runtime: loop.Runtime, *_: object, **__: object) -> None:
    known = runtime.__dict__.setdefault("_noted", [-1] * len(runtime.robots))
    for row, robot in enumerate(runtime.robots):
        if (phase := robot.lifecycle.phase) != known[row]:
            known[row] = phase
            name, pid, reason = runtime._names[row], sim.current().process.pid, robot.lifecycle.reason
            current().phases.append((current().now, name, pid, phase, reason))


def _count_hazards(hazards: Hazards, *_: object) -> None:
    hazards.__dict__["_noted"] = len(hazards.incidents)


def _note_hazards(hazards: Hazards, *_: object) -> None:
    robots = (robot for runtime in current().runtimes.values() for robot in runtime.robots)
    name = next(robot.assignment.name for robot in robots if robot.hazards is hazards)
    news = hazards.incidents[hazards.__dict__["_noted"] :]
    current().hazards.extend((current().now, name, each.text) for each in news)


def _note_status(_: run_view.NetworkView, status: messages.Status) -> None:
    current().missing.append((current().now, status.robot, tuple(status.missing)))


def _note_pose(runtime: loop.Runtime, row: int, *_: object, **__: object) -> None:
    name, process, world = runtime._names[row], sim.current().process, current()
    world.poses.append((world.now, name, process.pid))
    for watch in world.on_pose:
        watch(name, process)


def _note_case(_: conducting.CaseRun, context: Any, *_a: object, **__: object) -> None:
    current().plan = context.plan
    current().cases.append(context.case)
    measured = [name for name, robot in context.plan.experiment.robots.items() if robot.position == "external"]
    outside = [name for name in measured if context.plan.experiment.robots[name].body != "world"]
    if outside and context.plan.experiment.positioning is None:
        sim.Process("capture", lambda: bodies.capture(outside, context.plan.experiment.network.realm))


def _note_event(view: run_view.NetworkView, kind: str, _: str, text: str, stamp: float | None = None) -> None:
    if kind == "ready":
        current().reach("ready")
    elif kind == "phase" and text.startswith("landing"):
        current().reach("landing")
    elif kind == "start" and stamp is not None:
        current().reach("start", current().now + stamp - view.clock.utc())
