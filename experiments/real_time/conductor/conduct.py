"""Runs an experiment in real time: a router, a process per robot, a recorder.

See also `experiments.virtual_time.simulation`.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec

from agents.network import session as network_session
from agents.network.access_control import rules
from agents.network.endpoints import free_endpoints, from_here
from agents.network.keys import Keys
from agents.network.lab import LabError, lab_of, register, require, secured
from agents.network.lab import options as lab_options
from agents.network.shutdown import closing_cleanly
from agents.network.zenoh_config import ASK_S, LEASE_S, check_loopback
from agents.plugins import registry as plugins
from experiments.definition import access_rights, mesh
from experiments.definition import endpoints as endpoint_choice
from experiments.definition.bodies import choose_bodies
from experiments.definition.experiment import WORLD
from experiments.definition.plan import Plan
from experiments.file.document import Document, chosen
from experiments.file.problems import refusal
from experiments.real_time.conductor.case_processes import CaseContext
from experiments.real_time.conductor.conductor import CaseResult, Conductor
from experiments.real_time.conductor.orders import STARTING_S, Emergency
from experiments.real_time.conductor.run_view import ProgressDisplay
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.hosts.launcher import (
    Launcher,
    Router,
    RouterEnded,
    make_routers,
    start_routers,
    travel_s,
)
from experiments.real_time.hosts.run_registry import RegisteredRun
from experiments.recording.run_folder import SOURCE

SILENT_S: Final = LEASE_S  # limit for a router to answer
LOOK_S: Final = 0.05
PORT_CHOICES: Final = 3  # attempts of a run with no `network.listen`: others may take a free port before


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that its file leaves open."""

    cases: Sequence[str] = ()  # names of its cases; all if none is named
    # body of every robot instead of the file's: "twin", "world", or "protocol" for its real bridge and a protocol twin
    bodies: str | None = None
    here: bool = False  # whether all robots run on this machine, whatever hosts the file has
    lab: str | None = None  # folder of certificates, instead of the file's
    identity: str = "operator"  # identity of the conductor, in a lab: an operator


@dataclass(frozen=True)
class Supervision:
    """Means of a user to follow and end a run."""

    show: ProgressDisplay  # shows the progress
    interrupted: Callable[[], bool]  # whether the user wants to end: all robots land, and what was recorded is kept
    emergency: Emergency = field(default_factory=Emergency)  # receives emergency stops, which end the run as well
    tell: Callable[[Sequence[str]], None] = lambda _: None  # receives notes for the user before the start
    launching: Callable[[Path], Launcher] = Launcher  # makes the launcher of the processes, by the folder of their logs


@dataclass(frozen=True)
class Conducted:
    """End of a run in real time."""

    recordings: dict[str, Path]  # files of the cases that have begun, by name
    notes: list[str]  # remarks for the reader
    failures: list[str]  # failures that the recordings may not tell: the run is spoilt


def conduct(read: Document, folder: Path, options: RunOptions, user: Supervision) -> Conducted:
    """Run an experiment in real time: a router, a process per robot, a recorder.

    Args:
        user: After an interrupt or an emergency stop no further case begins; nor when an operator has landed, stopped
            or held robots, and may be among them.

    Raises:
        LabError: If a certificate is missing.
        EndpointError: If a router would have to listen where others could connect, without a lab.
        RunFailed: If robots are not ready in time, unless the file says to go on without them.
        Unreachable: If the routers of the file do not answer.
        HostError: If a host cannot be reached, or has another zenpark.
        DocumentError: If robots that run on hosts are to be put behind protocol twins, or are hardware that another
            run of this machine has.
    """
    results: dict[str, CaseResult] = {}
    embodied = with_bodies(read, options)
    emergency, halted = user.emergency, ""
    with run_setup(read, embodied, folder, options, user) as (contexts, left), user.show as show:
        for name, context in contexts.items():
            if context.ended():
                break
            results[name] = Conductor(context, show).run()
            if halted := results[name].halted:
                break
    unflown = ", ".join(name for name in embodied if name not in results)
    stopped = [emergency.words + (f"; not run: {unflown}" if unflown else "")] if emergency else []
    failures = [f"{case}: {why}" for case, result in results.items() for why in result.failures]
    failures += [f"not run: {unflown}, since {halted}"] if halted and unflown else []
    # a failure says why the recording of a case is not there
    begun = {case: end.recording for case, end in results.items() if end.start is not None and end.recording.is_file()}
    untold = [f"{case}: {why}" for case, end in results.items() if case not in begun for why in end.failures]
    return Conducted(begun, [*stopped, *untold, *left], failures)


def with_bodies(read: Document, options: RunOptions) -> dict[str, Plan]:
    """The chosen cases of an experiment, with the bodies and on the machines that are asked for."""
    if options.bodies == "protocol" and read.experiment.hosts and not options.here:
        hint = "add --here, which lets all robots run on this machine"
        raise refusal("--bodies protocol", "protocol twins cannot be seen from hosts", hint)
    embodied = {name: choose_bodies(case, options.bodies) for name, case in chosen(read, options.cases).items()}
    if options.here:
        embodied = {name: case.changed(hosts={}) for name, case in embodied.items()}
    return embodied


# contexts of the cases, and what was left behind on hosts, known at the end
RunSetup = tuple[dict[str, CaseContext], list[str]]


@contextmanager
def run_setup(
    read: Document, embodied: Mapping[str, Plan], folder: Path, options: RunOptions, user: Supervision
) -> Iterator[RunSetup]:
    """Put routers and hosts up for some cases, list the run on this machine, and listen for emergency stops.

    Args, Raises: As `conduct`; `embodied` are the cases, see `with_bodies`.
    """
    read.keep(folder / SOURCE)
    with ExitStack() as up:
        for left in reversed(range(1 if read.experiment.network.listen else PORT_CHOICES)):
            try:
                setup = up.enter_context(_run_setup(read, embodied, folder, options, user))
                break
            except RouterEnded:
                if not left:
                    raise
        yield setup


@contextmanager
def _run_setup(
    read: Document, embodied: Mapping[str, Plan], folder: Path, options: RunOptions, user: Supervision
) -> Iterator[RunSetup]:
    """`run_setup`, at ports that are free now."""
    network = read.experiment.network
    meshed = network.topology == "mesh"
    own_router = network.connect is None and not meshed
    of_lab = endpoint_choice.lab_folder(read.plan, read.path, options.lab)
    secure = of_lab is not None
    own = network.listen or free_endpoints(network.routers, protocol="tls" if secure else "tcp")
    listening = endpoint_choice.router_endpoints(read.plan, read.path, own if own_router else [], options.lab)
    if own_router and not secure:
        for endpoint in listening:
            check_loopback(endpoint)
    endpoints = list(map(from_here, listening)) if own_router else listening
    if meshed:
        endpoints = secured(mesh.member_endpoints(embodied.values(), secure=secure), of_lab)
    rights = write_rights(embodied.values(), endpoints, folder, options.identity)
    (folder / mesh.ENDPOINTS).write_text("".join(f"{endpoint}\n" for endpoint in endpoints), "utf-8")
    me = run_registry.own_entry(
        "run", read.experiment.title or read.path.stem, endpoints,
        folder=folder, realm=network.realm, identity=options.identity, robots=hardware(embodied.values()),
    )  # fmt: skip
    with ExitStack() as up:
        unlisted = up.enter_context(run_registry.registered(me, user.emergency.obey))
        launcher = up.enter_context(user.launching(folder / "logs"))
        user.emergency.guard(launcher)
        launcher.land_s = travel_s(max(plan.experiment.arena.size[2] for plan in embodied.values()))
        user.tell([*([unlisted] if unlisted else []), *check_other_runs(me, run_registry.runs(), str(read.path))])
        launcher.preload()
        routers = make_routers(listening, network.routers) if own_router else []
        start_routers(launcher, routers, rights)
        hosts = Hosts(launcher, endpoints if meshed else listening)
        hosts.obey = user.emergency.receive
        # a mesh has no members yet: only the session of each case receives stops there
        if not meshed:
            wait_s = STARTING_S if own_router else ASK_S
            up.enter_context(user.emergency.throughout(endpoints, Keys(network.realm), options.identity, wait_s))
            up.enter_context(watched(launcher, routers, Keys(network.realm), options.identity))
        left: list[str] = []
        rest = (launcher, hosts, user.interrupted, rights, options.identity, user.emergency)
        source = folder / SOURCE
        contexts = {name: CaseContext(plan, name, folder, source, endpoints, *rest) for name, plan in embodied.items()}
        yield contexts, left
        left += hosts.sweep()


@contextmanager
def watched(launcher: Launcher, routers: Sequence[Router], keys: Keys, identity: str) -> Iterator[None]:
    """Inside, each router is asked all the time, by a session of its own; a silent one is killed.

    The case that is run starts it again (`CaseProcesses.again`). `identity` is a name in a certificate, in a lab.
    """
    over = threading.Event()

    def watch(router: Router) -> None:
        endpoints = [from_here(router.listen[0])]
        try:
            opened = network_session.open_session(
                endpoints, name="watchdog", wait_s=STARTING_S, identity=identity, stop=over
            )
        except network_session.Unreachable:
            return
        with closing_cleanly(opened) as (session, _):
            answers = network_session.RouterWatch(session, keys.conductor)
            while not over.wait(LOOK_S):
                now = time.monotonic()
                silent_s, age_s = now - answers.silent_since(now), launcher.age(router.name)
                if silent_s > SILENT_S and (age_s > silent_s or age_s > STARTING_S):
                    launcher.kill(router.name, f"killed, since it gave no answer for {silent_s:.1f} s")

    threads = [threading.Thread(target=watch, args=(router,), name="watchdog", daemon=True) for router in routers]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def hardware(cases: Iterable[Plan]) -> dict[str, str]:
    """Robots of some cases by name, with the address of those that are hardware, and the host on which they run."""
    found: dict[str, str] = {}
    simulated = {"twin", WORLD, "external", *plugins.names(plugins.DEVICES)}
    for case in (plan.experiment for plan in cases):
        hosts = {robot: host for host, each in case.hosts.items() for robot in each.robots}
        for name, robot in case.robots.items():
            if plugins.body_name(robot.body) in simulated:
                found.setdefault(name, "")
            else:
                device = f" {json.dumps(robot.device, sort_keys=True)}" if robot.device else ""
                found[name] = robot.body + device + (f" on {hosts[name]}" if name in hosts else "")
    return found


def check_other_runs(me: RegisteredRun, others: Iterable[RegisteredRun], file: str) -> list[str]:
    """Notes on other runs that are up and have robots of the same names.

    Raises DocumentError if a robot of the run is hardware that another one has.
    """
    notes = []
    for other in others:
        if (other.pid, other.born) == (me.pid, me.born) or not other.alive:
            continue
        taken = sorted(name for name, body in me.robots.items() if body and _drives_same_device(other, name, body))
        if taken:
            mesh_file = f"--connect @{other.folder}/{mesh.ENDPOINTS}"
            stop = lab_options(other.endpoints[0]) if len(other.endpoints) == 1 else mesh_file
            what = f"{', '.join(taken)} ({me.robots[taken[0]]}) is in another run, {other.words}"
            hint = f"end that one first: Ctrl-C in its terminal (pid {other.pid}), or `./zenpark estop {stop}`"
            raise refusal(file, what, hint)
        if same := sorted(me.robots.keys() & other.robots.keys()):
            notes.append(f"another run is up with robots of these names ({', '.join(same)}): {other.words}")
    return notes


def _drives_same_device(other: RegisteredRun, name: str, body: str) -> bool:
    """Whether another run drives the same device: an address that names none belongs to the robot of that name."""
    if plugins.body_name(body) == body:
        return other.robots.get(name) == body
    return body in other.robots.values()


def write_rights(
    cases: Collection[Plan], endpoints: Sequence[str], folder: Path, operator: str = "operator"
) -> Path | None:
    """Rights of all identities, as a file for the router; None without a lab.

    Robots on hosts have their certificates there, and need none here. Raises LabError if a certificate is missing, or
    of another role.
    """
    of = lab_of(endpoints)
    if of is None:
        return None
    known = register(of)
    require(of, list(dict.fromkeys(name for case in cases for name in access_rights.needed_identities(case, operator))))
    role = known.identities[operator].role
    if role != "operator":
        raise LabError(f"{operator} is {role} in the lab, and gives no orders: choose an operator with --as")
    made = access_rights.rights(cases)
    rules(made, known)  # errors are raised now, not by a router that does not start
    file = folder / "rights.json"
    file.write_bytes(msgspec.json.format(msgspec.json.encode(made), indent=1))
    return file
