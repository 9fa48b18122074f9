"""Commands that are processes of an experiment: robot, router, central controller, world, protocol twin, bridge."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer
from typer import Argument, Option

from tools import completion
from tools.commands.orders import world_app
from tools.options import (
    CONNECT,
    As,
    Bodies,
    Case,
    Connect,
    File,
    Lab,
    Lifeline,
    Realm,
    example,
    group,
    plain,
    routers,
    with_options,
)

if TYPE_CHECKING:
    from agents.network.access_control import Rights
    from experiments.real_time.processes.joining import Launch

L = TypeVar("L", bound="Launch")
app: Final = typer.Typer()
cameras_app: Final = group("Prepare cameras that see tags on robots.")
CAMERAS: Final = "bridges.motion_capture.cameras.reader"
Cameras = Annotated[Path, Argument(metavar="FILE", help="Cameras and tags of the lab: cameras.toml.")]


@dataclass(frozen=True)
class Started:
    """Options of the processes of an experiment."""

    case: Case = None
    connect: Connect = None
    lifeline: Lifeline = False
    lab: Lab = None

    def launch(self, kind: type[L], file: str, **more: Any) -> L:  # noqa: ANN401 - fields of the struct
        """The command line of a process as its library takes it."""
        common: dict[str, Any] = {**vars(self), "connect": self.connect or []}
        return kind(file=file, **common, **more)


@app.command(epilog=example("agent triangle KH01"))
@with_options
def agent(
    file: File,
    names: Annotated[
        list[str],
        Argument(
            metavar="NAME...", help="The robots of this process.", autocompletion=completion.members, callback=plain
        ),
    ],
    *,
    clock_correction: Annotated[
        float, Option(metavar="SECONDS", help="Offset from this machine's clock to the conductor's.")
    ] = 0.0,
    once: Annotated[bool, Option("--once", help="End when down after the experiment.")] = False,
    realm: Realm = "park",
    started: Started,
) -> int:
    """Be one robot of an experiment, or several that share a device.

    FILE "join" waits for whatever is run next; "-" is a line of JSON on standard input. At the end of its lifeline it
    lands first.
    """
    from experiments.real_time.processes.robot import RobotLaunch, fly

    given = {"names": names, "clock_correction": clock_correction, "once": once, "realm": realm}
    return fly(started.launch(RobotLaunch, file, **given))


@app.command(hidden=True)
def station() -> int:
    """Answer the launcher of another machine; `./zenpark run` starts it where robots of the experiment are."""
    from experiments.real_time.hosts.station import serve

    return serve()


@app.command(epilog=example("router", "router lab.toml --lab lab --listen tls/192.168.0.10:7447"))
def router(
    file: Annotated[str | None, Argument(metavar="[FILE]", help="Experiment with the rights in a lab.")] = None,
    *,
    listen: Annotated[
        list[str] | None,
        Option(metavar="ENDPOINT", help="Without a lab on loopback; may be repeated. [tcp/127.0.0.1:7447]"),
    ] = None,
    connect: Annotated[list[str] | None, Option(metavar="ENDPOINT", help="Another router; may be repeated.")] = None,
    lifeline: Lifeline = False,
    lab: Lab = None,
    bodies: Bodies = None,
    print_config: Annotated[bool, Option("--print-config", help="Print a zenohd's configuration instead.")] = False,
) -> int:
    """Run the Zenoh router that the robots meet at."""
    import json

    from agents.network.endpoints import DEFAULT_ENDPOINT
    from agents.network.lab import LabError, secured
    from agents.runtime.router import serve
    from experiments.real_time.hosts.run_registry import own_entry, registered

    if file is None and lab is not None:
        raise LabError(f"name the experiment too, from which the rights follow: ./zenpark router FILE --lab {lab}")
    rights, folder = (None, None) if file is None else _rights(file, lab, bodies)
    if folder is None:
        endpoints, linked = listen or [DEFAULT_ENDPOINT], connect or []
        rights = None
    else:
        endpoints, linked = secured(listen or [], folder), secured(connect, folder) if connect else []
    if print_config:
        print(json.dumps(of_zenohd(endpoints, linked, rights), indent=1))
        return 0
    with registered(own_entry("router", "a router by hand", _places(endpoints))) as why:
        if why:
            print(f"zenpark: {why}", file=sys.stderr)
        return serve(endpoints, link=linked, lifeline=lifeline, rights=rights)


def _places(endpoints: Sequence[str]) -> list[str]:
    """Addresses of a router on this machine, without ports that the system chooses and those that `serve` refuses."""
    from agents.network.endpoints import from_here

    places = []
    for endpoint in endpoints:
        with suppress(ValueError):
            places.append(from_here(endpoint))
    return places


def of_zenohd(endpoints: Sequence[str], link: Sequence[str] = (), rights: Rights | None = None) -> dict[str, Any]:
    """The configuration with which a zenohd is the router that `serve` would be, as its file has it."""
    from agents.network.zenoh_config import settings

    made: dict[str, Any] = {}
    for path, value in settings("router", listen=endpoints, connect=link, name="router", rights=rights).items():
        *above, last = path.split("/")
        inner = made
        for part in above:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return made


def _rights(file: str, lab: str | None, bodies: str | None) -> tuple[Rights, Path | None]:
    from experiments.definition import access_rights
    from experiments.definition import endpoints as endpoint_choice
    from experiments.definition.bodies import choose_bodies
    from experiments.file import document

    read = document.read(file)
    cases = [choose_bodies(case, bodies) for case in read.cases().values()]
    return access_rights.rights(cases), endpoint_choice.lab_folder(read.plan, read.path, lab)


@app.command(epilog=example("centre architectures --case centralised"))
@with_options
def centre(file: File, *, started: Started) -> int:
    """Be the centre of an experiment: decide for the robots that it guides."""
    from experiments.real_time.processes.centre import serve
    from experiments.real_time.processes.joining import Launch

    return serve(started.launch(Launch, file))


@world_app.command(name="serve", epilog=example("world serve obstacle-course"))
@with_options
def world(
    file: File,
    *,
    engine: Annotated[str | None, Option(metavar="NAME", help="Engine of the twins. [the file's]")] = None,
    started: Started,
) -> int:
    """Run the world of an experiment: its twins, with obstacles, contacts and range sensors."""
    from experiments.real_time.processes.world import WorldLaunch, serve

    return serve(started.launch(WorldLaunch, file, engine=engine))


@app.command(epilog=example("twin crazyflie --count 2", "twin tello --faults '{\"loss\": 0.05}'"))
def twin(
    kind: Annotated[str, Argument(metavar="KIND", help="Kind with a protocol twin, such as crazyflie.")],
    *,
    count: Annotated[int, Option(min=1, max=99, help="Number of robots.")] = 1,
    connect: Connect = None,
    faults: Annotated[str, Option(metavar="JSON", help="Faults, such as '{\"loss\": 0.05}'.")] = "{}",
    device: Annotated[str, Option(metavar="JSON", help="Settings of the device.")] = "{}",
    table: Annotated[
        list[str] | None,
        Option(
            metavar="FILE",
            help="A Crazyflie: parameters or log variables that it lists, a file of cflib's cache; may be repeated.",
        ),
    ] = None,
    lab: Lab = None,
    identity: As = "twin",
) -> int:
    """Stand in for hardware: protocol twins, to which vendor libraries connect."""
    from experiments.real_time.processes.protocol_twins import by_hand

    endpoints = routers(connect, lab)
    return by_hand(kind, count, faults=faults, device=device, tables=table or [], connect=endpoints, identity=identity)


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
    epilog=example("bridge optitrack 192.168.10.1 --map CF01=cf_1", "bridge ros2 --help"),
)
def bridge(
    context: typer.Context,
    what: Annotated[
        str,
        Argument(
            metavar="SYSTEM",
            help="vicon, optitrack, qualisys, vrpn, cameras, that of a plug-in, or ros2; with --help it says more.",
        ),
    ],
) -> int:
    """Bring in positions from motion capture, or show the robots to ROS 2."""
    from importlib import import_module

    from agents.plugins import registry

    if what in ("-h", "--help"):
        typer.echo(context.get_help())
        raise typer.Exit
    given = [part for each in os.environ.get(CONNECT, "").split() for part in ("--connect", each)]
    systems = registry.names(registry.POSITIONING)
    if what not in (*systems, "ros2"):
        raise typer.BadParameter(f"'{what}' is none of {', '.join(systems)}, ros2", param_hint="bridge")
    words = context.args if "--connect" in context.args else [*context.args, *given]
    if what == "ros2":
        return int(import_module("bridges.ros2.bridge").main(words))
    return int(import_module("bridges.motion_capture.publisher").main([what, *words]))


@cameras_app.command(epilog=example("cameras calibrate cameras.toml", "cameras calibrate cameras.toml --lens"))
def calibrate(
    file: Cameras,
    *,
    lens: Annotated[bool, Option("--lens", help="Measure also the lenses that are known.")] = False,
    limit: Annotated[float, Option(min=1.0, help="Time for the lenses, and for the places [s].")] = 300.0,
) -> None:
    """Measure the lenses and the places of cameras, and write them into their file."""
    from importlib import import_module

    import_module(CAMERAS).tool("calibrate").calibrate_file(file, again=lens, limit_s=limit)


@cameras_app.command(epilog=example("cameras coverage cameras.toml --room 3.4 3.4 1.5"))
def coverage(
    file: Cameras,
    *,
    room: Annotated[tuple[float, float, float], Option(help="Sides along x and y, and height [m].")] = (3.0, 3.0, 1.5),
) -> None:
    """Print the places of a room in which cameras see the tags of robots, also before the cameras hang."""
    from importlib import import_module

    for line in import_module(CAMERAS).tool("coverage").report(file, room):
        print(line)


@cameras_app.command(name="print", epilog=example("cameras print cameras.toml tags.html"))
def print_sheets(
    file: Cameras, page: Annotated[Path, Argument(metavar="HTML", help="Page.")] = Path("tags.html")
) -> None:
    """Write a page with the tags of a file and the board, to print in true size."""
    from importlib import import_module

    import_module(CAMERAS).tool("calibrate").print_sheets(file, page)
    print(page)
