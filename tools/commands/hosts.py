"""`./zenpark hosts`: check whether other machines of an experiment can take part, and install this zenpark there."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Argument, Option

from tools.commands.lab import SOON_DAYS
from tools.options import AsJson, File, Lab, Settings, example, group, known_words, print_json

if TYPE_CHECKING:
    from experiments.definition.experiment import Host
    from experiments.definition.plan import Plan
    from experiments.file.document import Document
    from experiments.real_time.hosts.hosts import HostError, Station
    from experiments.real_time.hosts.station import HostCheck

app: Final = group("Check the other machines of an experiment, and put zenpark there.")
turtlebot_app: Final = group("Prepare a TurtleBot3 for experiments.")
On = Annotated[
    list[str] | None, Option(metavar="HOST|TAG", help="Only this host, or those with this tag; may be repeated.")
]

YES, NO, DOUBTFUL, NOTHING = "✓", "✗", "!", "–"
HEADING: Final = ("host", "reachable", "zenpark", "Python", "clock", "devices", "router")
SECURED: Final = (*HEADING[:-1], "certificates", HEADING[-1])  # columns in a lab
VAGUE_S: Final = 0.02  # a clock with a larger uncertainty lets robots start apart
REACH_S: Final = 15.0


@dataclass
class HostRow:
    """Result of one host: its cells by column, and the remedies."""

    cells: dict[str, str]
    trouble: list[str] = field(default_factory=list)
    blank: str = NOTHING  # text of columns without a cell

    @property
    def well(self) -> bool:
        """Whether nothing stands in the way of a run."""
        return not any(cell.startswith(NO) for cell in (self.blank, *self.cells.values()))

    def shown(self, heading: Sequence[str]) -> dict[str, str]:
        """Cells of all columns."""
        return {column: self.cells.get(column, self.blank) for column in heading}


@turtlebot_app.command(epilog=example("turtlebot watchdog ubuntu@192.168.0.31 --namespace tb3_0"))
def watchdog(
    robot: Annotated[
        str | None, Argument(metavar="[USER@ROBOT]", help="TurtleBot3 that ssh reaches; none: print the file.")
    ] = None,
    *,
    namespace: Annotated[str, Option(help="Namespace of the robot's nodes, such as tb3_0.")] = "",
    domain: Annotated[int, Option(min=0, max=232, help="ROS_DOMAIN_ID of the robot.")] = 30,
    silence: Annotated[float, Option(min=0.1, max=5.0, help="Time without a command after which it stops [s].")] = 0.5,
    remove: Annotated[bool, Option("--remove", help="Remove it.")] = False,
) -> None:
    """Install a watchdog on a TurtleBot3, which stops it when no command arrives."""
    from agents.plugins import registry
    from experiments.real_time.hosts import installation

    kind = registry.load(registry.ROBOTS, "turtlebot3")
    if robot is None:
        sys.stdout.write(installation.watchdog(kind).read_text("utf-8"))
        return
    address = registry.find(kind.ros_address, f"ROS 2 of the kind {kind.name}")
    at = address(robot, f"ros2dds://{namespace}", {}, of_twin=False)
    said = (
        installation.remove_watchdog(kind, robot)
        if remove
        else installation.put_watchdog(kind, robot, namespace=at.namespace, domain=domain, silence_s=silence)
    )
    for line in said:
        print(f"{robot}: {line}")


@app.command(epilog=example("hosts check lab.toml", "hosts check lab.toml --on lab2 --json"))
def check(file: File, settings: Settings = None, on: On = None, lab: Lab = None, as_json: AsJson = False) -> int:
    """Say whether each host can take part: version, clock, devices, certificates, router."""
    from experiments.definition import endpoints
    from experiments.file import document
    from tools.progress import columns

    read = document.read(file, settings or [])
    experiment = read.experiment
    chosen = choose(experiment.hosts, on or [])
    heading = HEADING if endpoints.lab_folder(read.plan, read.path, lab) is None else SECURED
    rows = []
    for name, host in chosen.items():
        if host.address is None:  # its robots join by themselves
            text = f"{NOTHING} no address: {', '.join(host.robots) or 'no robots'} started there"
            rows.append(HostRow({"host": name, "reachable": text}))
    with stations(read, {name: host for name, host in chosen.items() if host.address is not None}, lab) as found:
        rows += [_row(each, read.plan) for each in found]
    well = all(row.well for row in rows)
    if as_json:
        shown = [{**row.shown(heading), "ok": row.well, "trouble": row.trouble} for row in rows]
        print_json({"ok": well, "hosts": shown})
    else:
        print("\n".join(columns([heading, *([*row.shown(heading).values()] for row in rows)])))
        for each in (each for row in rows for each in row.trouble):
            print(each, file=sys.stderr)
    return int(not well)


@app.command(epilog=example("hosts install lab.toml"))
def install(file: File, settings: Settings = None, on: On = None, lab: Lab = None, as_json: AsJson = False) -> int:
    """Put this zenpark on every host that has another or none, and in a lab the certificates of its robots."""
    from experiments.definition import endpoints
    from experiments.file import document
    from experiments.real_time.hosts import certificates
    from experiments.real_time.hosts.hosts import HostError
    from experiments.real_time.hosts.installation import put, send
    from experiments.recording import version

    read = document.read(file, settings or [])
    experiment = read.experiment
    folder = endpoints.lab_folder(read.plan, read.path, lab)
    chosen = {name: host for name, host in choose(experiment.hosts, on or []).items() if host.address is not None}
    shown: list[dict[str, str | bool]] = []
    with stations(read, chosen, lab, routed=False) as found:
        for (name, host), station in zip(chosen.items(), found, strict=True):
            row: dict[str, str | bool] = {"host": name, "ok": True}
            shown.append(row)
            same = not isinstance(station, HostError) and station.same_version
            own = version.digest()[: version.DIGEST_CHARACTERS]
            try:
                row["zenpark"] = f"has it already ({own})" if same else put(name, host)
                if not as_json:
                    print(f"{name}: {row['zenpark']}", flush=True)
                if folder is not None and host.robots:
                    robots = certificates.of_host(name, experiment.hosts)
                    right = not isinstance(station, HostError) and same and _has_certificates(station, folder, robots)
                    row["certificates"] = "has its certificates" if right else send(name, host, folder, robots)
                    if not as_json:
                        print(f"{name}: {row['certificates']}")
            except HostError as error:
                row |= {"ok": False, "trouble": str(error)}
                print(error, file=sys.stderr)
    done = all(row["ok"] for row in shown)
    if as_json:
        print_json({"ok": done, "hosts": shown})
    return int(not done)


def choose(hosts: Mapping[str, Host], only: Sequence[str]) -> dict[str, Host]:
    """Hosts by name or tag, all if none is named."""
    from experiments.file.problems import refusal

    wanted = known_words("--on", only, sorted({*hosts, *(tag for host in hosts.values() for tag in host.tags)}))
    if not hosts:
        hint = 'add one: [hosts.lab1] with address = "user@machine" and robots = ["..."]'
        raise refusal("[hosts]", "the experiment has no hosts: all robots run here", hint)
    return {name: host for name, host in hosts.items() if not wanted or {name, *host.tags} & {*wanted}}


def _has_certificates(station: Station, folder: Path, robots: Sequence[str]) -> bool:
    """Whether a host holds the certificates of its robots, and no others."""
    from experiments.real_time.hosts import certificates

    content = station.folder_content(robots)
    return not (
        content.others or [*certificates.faults(content, folder, time.time()), *certificates.ended(folder, robots)]
    )


@contextmanager
def stations(
    read: Document, hosts: Mapping[str, Host], lab: str | None, *, routed: bool = True
) -> Iterator[list[Station | HostError]]:
    """A connection to each host, or why there is none, and, if `routed`, a router as a run would have it.

    Raises LabError if a certificate is missing here.
    """
    import tempfile

    from agents.network.endpoints import free_endpoint
    from experiments.definition import endpoints
    from experiments.real_time.conductor.conduct import write_rights
    from experiments.real_time.hosts.hosts import HostError, Station
    from experiments.real_time.hosts.launcher import ROUTER, Launcher, Router

    experiment = read.experiment
    with tempfile.TemporaryDirectory() as folder, Launcher(Path(folder)) as launcher:
        network, own = experiment.network, []
        secure = endpoints.lab_folder(read.plan, read.path, lab) is not None
        if not routed:
            routers = []
        elif network.connect is None:
            own = network.listen or [free_endpoint(protocol="tls" if secure else "tcp")]
            routers = endpoints.router_endpoints(read.plan, read.path, own, lab)
            Router(ROUTER, routers).start(launcher, write_rights(read.cases().values(), routers, Path(folder)))
        else:
            routers = endpoints.router_endpoints(read.plan, read.path, network.connect, lab)
        begun: list[Station | HostError] = []
        for name, host in hosts.items():
            try:
                begun.append(Station(name, host, launcher=launcher, routers=routers, run="check"))
            except HostError as error:
                begun.append(error)
        found: list[Station | HostError] = []
        for each in begun:
            try:
                if isinstance(each, Station):
                    each.greet(experiment.network.address)
                found.append(each)
            except HostError as error:
                found.append(error)
        yield found


def _row(station: Station | HostError, plan: Plan) -> HostRow:
    """Everything about one host."""
    from experiments.real_time.hosts.hosts import HostError

    if isinstance(station, HostError):
        return HostRow({"host": str(station).partition(":")[0], "reachable": NO}, [str(station)])
    row = HostRow({"host": station.name, "reachable": f"{YES} {station.hello.machine}"})
    try:
        _fill(row, station, plan)
    except HostError as error:
        row.blank = NO
        row.trouble.append(str(error))
    return row


def _fill(row: HostRow, station: Station, plan: Plan) -> None:
    from experiments.real_time.hosts.station import Question
    from experiments.recording import version

    here = version.digest()[: version.DIGEST_CHARACTERS]
    row.cells["zenpark"] = f"{YES} {here}"
    if not station.same_version:
        row.cells["zenpark"] = f"{NO} {station.hello.zenpark[: version.DIGEST_CHARACTERS]}, here {here}"
        row.trouble.append(
            f"{station.name}: another zenpark is there; `./zenpark hosts install FILE` puts this one there"
        )
    row.cells["Python"] = f"{YES} {station.hello.python}"
    clock = station.measure()
    vague = clock.uncertainty > VAGUE_S
    offset = f"{clock.offset * 1e3:+.2f} ± {clock.uncertainty * 1e3:.2f} ms"
    row.cells["clock"] = f"{DOUBTFUL if vague else YES} {offset}"
    if vague:
        row.trouble.append(
            f"{station.name}: the connection is slow, so robots there may start ± {clock.uncertainty * 1e3:.0f} ms "
            "apart from the others; use a cable, or a network with less on it"
        )
    bodies = [plan.experiment.robots[robot].body for robot in station.host.robots]
    devices = station.ask(Question("devices", bodies=bodies), REACH_S)[0].found
    wrong = [each for each in devices if not each.well]
    words = ", ".join(each.what for each in devices) or "none needed"
    row.cells["devices"] = f"{NO if wrong else YES} {words}"
    row.trouble += [f"{station.name}: {each.what} {each.text}" for each in wrong]
    if station.lab is not None and not _recognised(row, station, station.lab, plan):
        row.cells["router"] = f"{NOTHING} needs its certificates"
        return
    lab: dict[str, Any] = {} if station.lab is None else {"lab": station.folder, "names": station.host.robots}
    routers = station.ask(Question("reach", endpoints=station.endpoints, **lab), REACH_S)[0].found
    unreached = [each for each in routers if not each.well]
    reached = ", ".join(each.text for each in routers if each.well)
    row.cells["router"] = f"{NO if unreached else YES} {reached}".rstrip()
    row.trouble += [
        f"{station.name}: {each.what} cannot be reached from there; {_router_remedy(station, each, plan)}"
        for each in unreached
    ]


def _router_remedy(station: Station, router: HostCheck, plan: Plan) -> str:
    """Remedy for a router that a host does not reach."""
    from agents.network.endpoints import Endpoint

    if "refuses the certificate" in router.text and Endpoint.parse(router.what).is_loopback:
        return f"ssh carries it, so look at the certificates: `./zenpark lab show {station.lab}`"
    if plan.experiment.network.connect is not None:
        return "is it on (`./zenpark router` starts one)? Else mend connect in [network]"
    if plan.experiment.network.listen is not None:
        return "mend address or listen in [network], or leave both out: then ssh carries it; is there a firewall here?"
    return "ssh carries it: does sshd there allow that (AllowTcpForwarding yes)? Else add listen to [network]"


def _recognised(row: HostRow, station: Station, folder: Path, plan: Plan) -> bool:
    """Add what a host holds of the lab's certificates to its row; whether its robots would be let in."""
    from experiments.real_time.hosts import certificates

    wrong = station.distrusted(station.host.robots)
    content = station.folder_content(certificates.of_host(station.name, plan.experiment.hosts))
    misplaced_keys = [f"{station.name}: {each}" for each in certificates.misplaced_keys(content, station.name)]
    left = certificates.days_left(folder, station.host.robots)
    soon = not wrong and left < SOON_DAYS
    mark = NO if wrong or misplaced_keys else DOUBTFUL if soon else YES
    row.cells["certificates"] = f"{mark} {len(content.identities)}, {left:.0f} days left" if not wrong else mark
    row.trouble += [*wrong, *misplaced_keys]
    if soon:
        remedy = f"`./zenpark lab renew {folder} {' '.join(station.host.robots)}`, then `./zenpark hosts install FILE`"
        row.trouble.append(f"{station.name}: its certificates end in {left:.0f} days; {remedy}")
    return not wrong
