"""The command line: signatures and help only. What a command does is imported when it runs, so that help is quick."""

from __future__ import annotations

import sys
from typing import Annotated, Final

import typer

from tools.keys import app as keys

app: Final = typer.Typer(
    name="zenpark",
    help="Distributed experiments with several robots, on Zenoh.",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich help costs 100 ms at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

# The errors that explain themselves, by the module that defines them: one that was raised has its module loaded,
# so that nothing needs to be imported to recognise it.
EXPLAINED: Final = (
    ("agents.session", "EndpointError"),
    ("agents.lab", "LabError"),
    ("agents.session", "Unreachable"),
    ("agents.body", "BodyError"),
    ("agents.runtime", "NameTaken"),
    ("agents.plugins", "PluginError"),
    ("experiments.problem", "DocumentError"),
    ("experiments.records", "RecordingError"),
    ("experiments.export", "ExportError"),
    ("experiments.conductor", "RunFailed"),
    ("experiments.hosts", "HostError"),
    ("experiments.virtual", "Stuck"),
    ("experiments.sweep_workers", "SweepError"),
    ("experiments.standins", "StandInError"),
    ("experiments.world", "WorldTaken"),
    ("experiments.centre", "CentreTaken"),
    ("tools.world", "WorldOrderError"),
    ("tools.network", "KeyExpressionError"),
)

File = Annotated[str, typer.Argument(metavar="FILE", help="Experiment file, or the name of a ready-made one.")]
Connect = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help="A router; may be repeated. [tcp/127.0.0.1:7447]")
]
Lab = Annotated[str | None, typer.Option(metavar="FOLDER", help="Certificates of a lab (`zenpark keys init`).")]
As = Annotated[str, typer.Option("--as", metavar="NAME", help="Whose certificate, in a lab.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="Changes a value of the file; may be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="For programs.")]
KeyExpression = Annotated[str, typer.Argument(metavar="KEY", help="Key expression, such as park/*/pose.")]
Seconds = Annotated[float | None, typer.Option(min=0.0, help="End after this time [s].")]


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # noqa: PLC0415

        typer.echo(f"zenpark {version('zenpark')}")
        raise typer.Exit


@app.callback()
def _zenpark(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")] = False,
) -> None: ...


@app.command()
def run(
    file: File,
    *,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="In virtual time, in this process, as fast as it goes.")
    ] = False,
    case: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this case; may be repeated.")] = None,
    out: Annotated[str | None, typer.Option(metavar="FOLDER", help="Where the results go. [runs/...]")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all randomness, instead of the file's.")] = None,
    settings: Settings = None,
    as_json: AsJson = False,
    seeds: Annotated[int, typer.Option(min=1, help="Runs so many seeds: mean and spread (virtual only).")] = 1,
    bodies: Annotated[
        str | None,
        typer.Option(
            metavar="twin|world|protocol",
            help="Every robot in a twin of its own, in one world, or behind a protocol twin (real time).",
        ),
    ] = None,
    here: Annotated[bool, typer.Option("--here", help="All robots on this machine, whatever [hosts] says.")] = False,
    anyway: Annotated[bool, typer.Option("--anyway", help="Runs it although the check finds errors.")] = False,
    report: Annotated[bool, typer.Option(help="Writes the report.")] = True,
    open_report: Annotated[bool, typer.Option("--open", help="Opens the report in the browser.")] = False,
    lab: Lab = None,
) -> None:
    """Run an experiment: one process per robot, or in virtual time."""
    from experiments.commands import run as command  # noqa: PLC0415

    raise typer.Exit(
        command(
            file,
            virtual=virtual,
            cases=case or [],
            out=out,
            seed=seed,
            settings=settings or [],
            as_json=as_json,
            seeds=seeds,
            bodies=bodies,
            here=here,
            anyway=anyway,
            report=report,
            open_report=open_report,
            lab=lab,
        )
    )


@app.command()
def sweep(
    file: File,
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PATH=VALUES...]",
            help="What changes: trigger.threshold=0.002:0.05:log12, or lin12, or a list 1,2,3; several make a grid. "
            "seeds=50 or seeds=101:150 [20 from the file's on]; tuning=1001:1060 for --optimize.",
        ),
    ] = None,
    *,
    case: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this case; may be repeated.")] = None,
    settings: Settings = None,
    optimize: Annotated[
        str | None,
        typer.Option(
            metavar="WISH",
            help="Seeks values in the ranges instead: 'messages, iae<=1.01' (relative to the first case).",
        ),
    ] = None,
    out: Annotated[str | None, typer.Option(metavar="FOLDER", help="Where runs and table are kept. [runs/...]")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="How many at once. [one per core]")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="On the workers of this dask scheduler, tcp://HOST:PORT.")
    ] = None,
    as_json: AsJson = False,
    anyway: Annotated[bool, typer.Option("--anyway", help="Runs it although the check finds errors.")] = False,
    report: Annotated[bool, typer.Option(help="Writes the page and the figure.")] = True,
    open_report: Annotated[bool, typer.Option("--open", help="Opens the page in the browser.")] = False,
) -> None:
    """Run cases x values x seeds in virtual time on all cores; what is done is never run again."""
    from experiments.sweep_command import Request  # noqa: PLC0415
    from experiments.sweep_command import command as run_sweep  # noqa: PLC0415

    raise typer.Exit(
        run_sweep(
            Request(
                file=file,
                given=given or [],
                settings=settings or [],
                cases=case or [],
                out=out,
                scheduler=scheduler,
                processes=processes,
                optimize=optimize,
                as_json=as_json,
                anyway=anyway,
                report=report,
                open_report=open_report,
            )
        )
    )


@app.command()
def agent(
    file: File,
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="The robots of this process.")],
    *,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the first]")] = None,
    connect: Connect = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", help="Land and end when standard input ends or falls silent.")
    ] = False,
    clock_correction: Annotated[
        float, typer.Option(metavar="SECONDS", help="Added to this machine's clock to get the conductor's.")
    ] = 0.0,
    once: Annotated[bool, typer.Option("--once", help="End when down after the experiment.")] = False,
    realm: Annotated[str, typer.Option(metavar="NAME", help="In which to join.")] = "park",
    lab: Lab = None,
) -> None:
    """Be one robot of an experiment, or several that share a device.

    FILE "join" waits for whatever is run next; "-" is a line of JSON on standard input.
    """
    from experiments.robot import fly  # noqa: PLC0415

    raise typer.Exit(
        fly(
            file,
            names,
            case=case,
            connect=connect or [],
            lifeline=lifeline,
            clock_correction_s=clock_correction,
            once=once,
            realm=realm,
            lab=lab,
        )
    )


@app.command(hidden=True)
def station() -> None:
    """Answer the launcher of another machine; `zenpark run` starts it where robots of the experiment are."""
    from experiments.station import serve  # noqa: PLC0415

    raise typer.Exit(serve())


@app.command()
def router(
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="The experiment whose rights it enforces, in a lab.")
    ] = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Without a lab on loopback; may be repeated. [tcp/127.0.0.1:7447]"),
    ] = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", help="End when standard input ends or is silent for 3 s.")
    ] = False,
    lab: Lab = None,
    bodies: Annotated[
        str | None, typer.Option(metavar="twin|world|protocol", help="As behind `zenpark run`, for the rights.")
    ] = None,
) -> None:
    """Run the Zenoh router that the robots meet at."""
    from tools.router import command  # noqa: PLC0415

    raise typer.Exit(command(file, listen=listen or [], lifeline=lifeline, lab=lab, bodies=bodies))


@app.command()
def centre(
    file: File,
    *,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the first]")] = None,
    connect: Connect = None,
    lifeline: Annotated[bool, typer.Option("--lifeline", help="End when standard input ends or falls silent.")] = False,
    lab: Lab = None,
) -> None:
    """Be the centre of an experiment: decide for the robots that it guides."""
    from experiments.centre import serve  # noqa: PLC0415

    raise typer.Exit(serve(file, case=case, connect=connect or [], lifeline=lifeline, lab=lab))


@app.command()
def world(
    file: File,
    *,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the first]")] = None,
    connect: Connect = None,
    engine: Annotated[str | None, typer.Option(metavar="NAME", help="What moves the twins. [the file's]")] = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", help="End, after its robots, when standard input ends or falls silent.")
    ] = False,
    lab: Lab = None,
) -> None:
    """Be the world of an experiment: carry its twins, with obstacles, contacts and range sensors."""
    from experiments.world import serve  # noqa: PLC0415

    raise typer.Exit(serve(file, case=case, connect=connect or [], lifeline=lifeline, engine=engine, lab=lab))


@app.command()
def twin(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="crazyflie, tello, khepera4 or turtlebot3.")],
    count: Annotated[int, typer.Option(min=1, max=99, help="How many.")] = 1,
    connect: Connect = None,
    faults: Annotated[str, typer.Option(metavar="JSON", help="What goes wrong, such as '{\"loss\": 0.05}'.")] = "{}",
    device: Annotated[str, typer.Option(metavar="JSON", help="Settings of the device.")] = "{}",
) -> None:
    """Stand in for hardware: protocol twins, to which vendor libraries connect."""
    from experiments.device import command  # noqa: PLC0415

    raise typer.Exit(command(kind, count, faults=faults, device=device, connect=connect or []))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})
def bridge(
    context: typer.Context,
    what: Annotated[str, typer.Argument(metavar="vicon|ros2", help="`zenpark bridge vicon --help` says more.")],
) -> None:
    """Bring motion capture in (vicon), or show the robots to ROS 2 (ros2)."""
    from importlib import import_module  # noqa: PLC0415

    if what in ("-h", "--help"):
        typer.echo(context.get_help())
        raise typer.Exit
    if what not in ("vicon", "ros2"):
        raise typer.BadParameter(f"'{what}' is neither vicon nor ros2")
    raise typer.Exit(import_module(f"bridges.{what}").main(context.args))


@app.command()
def check(file: File, settings: Settings = None, as_json: AsJson = False) -> None:
    """Check an experiment file and say what theory says of it."""
    from experiments.check import command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], as_json=as_json))


@app.command()
def report(
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Folders of runs.")],
    out: Annotated[str | None, typer.Option(metavar="FILE", help="Where the report goes. [the run's folder]")] = None,
) -> None:
    """Write the report of one run, or compare several."""
    from experiments.commands import report as command  # noqa: PLC0415

    raise typer.Exit(command(runs, out=out))


@app.command()
def export(
    folder: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a run.")],
    target: Annotated[
        str | None, typer.Argument(metavar="FILE", help="FILE.mat or FILE.csv. [run.mat in the run's folder]")
    ] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="A table of trajectories: case, time, robot, x, ...")] = False,
) -> None:
    """Write a run for MATLAB, or its trajectories as one table."""
    from experiments.export import command  # noqa: PLC0415

    raise typer.Exit(command(folder, target, as_csv=as_csv))


@app.command()
def recover(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A recording that was cut off.")],
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="Where the whole one goes.")] = None,
) -> None:
    """Repair a recording whose writer was killed."""
    from experiments.recover import recover_command  # noqa: PLC0415

    raise typer.Exit(recover_command(file, target))


@app.command()
def new(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="A ready-made experiment (`zenpark list`); TARGET behind a formation."),
    ] = None,
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="The file to write. [NAME.toml]")] = None,
    *,
    polygon: Annotated[int | None, typer.Option(metavar="N", help="Robots on a regular polygon.")] = None,
    grid: Annotated[str | None, typer.Option(metavar="RxC", help="Robots on a grid, such as 5x8.")] = None,
    hemisphere: Annotated[int | None, typer.Option(metavar="N", help="On a hemisphere, with Delaunay links.")] = None,
    henneberg: Annotated[int | None, typer.Option(metavar="N", help="Minimally rigid: 2N - 3 links.")] = None,
    circulant: Annotated[int | None, typer.Option(metavar="N", help="On a circle, linked by --jumps.")] = None,
    jumps: Annotated[str, typer.Option(metavar="J,J", help="Of a circulant: i hears i ± J.")] = "1,2",
    kind: Annotated[str, typer.Option(metavar="KIND", help="Of the robots of a formation.")] = "crazyflie",
    spacing: Annotated[float, typer.Option(min=0.01, help="Between neighbours [m].")] = 0.6,
    scatter: Annotated[
        float | None, typer.Option(min=0.0, help="Starts are drawn this far around, by seed [m]. [0.3 spacing]")
    ] = None,
    law: Annotated[str, typer.Option(metavar="distance|displacement", help="Of a formation.")] = "distance",
    seed: Annotated[int, typer.Option(min=0, help="Of the file.")] = 1,
    duration: Annotated[float, typer.Option(min=1.0, help="[s]")] = 60.0,
) -> None:
    """Begin an experiment file from a ready-made one, or with a formation of any size."""
    asked = {"polygon": polygon, "grid": grid, "hemisphere": hemisphere, "henneberg": henneberg, "circulant": circulant}
    formations = [(what, str(size)) for what, size in asked.items() if size is not None]
    if not formations:
        if name is None:
            raise typer.BadParameter("give a NAME (`zenpark list`), or a formation such as --hemisphere 40")
        from experiments.commands import new as copied  # noqa: PLC0415

        raise typer.Exit(copied(name, target))
    if len(formations) > 1 or target is not None:
        what = f"--{formations[1][0]}" if len(formations) > 1 else f"'{target}'"
        raise typer.BadParameter(f"{what} is too much behind --{formations[0][0]}: one formation, one TARGET")
    from experiments.generate import Wanted, command  # noqa: PLC0415

    wanted = Wanted(kind=kind, spacing=spacing, scatter=scatter, seed=seed, duration_s=duration, law=law)
    raise typer.Exit(command(*formations[0], name, wanted, jumps))


@app.command(name="import")
def import_(
    file: Annotated[str, typer.Argument(metavar="FILE.yaml", help="An experiment of Robotic Park's authors.")],
    target: Annotated[str | None, typer.Argument(metavar="TARGET", help="The file to write. [FILE.toml]")] = None,
    duration: Annotated[float, typer.Option(min=1.0, help="Their files do not say how long [s].")] = 60.0,
) -> None:
    """Turn an experiment file of Robotic Park's authors into one of zenpark."""
    from experiments.importing import command  # noqa: PLC0415

    raise typer.Exit(command(file, target, duration))


@app.command(name="list")
def list_() -> None:
    """List the ready-made experiments and the plugins."""
    from experiments.commands import list_all  # noqa: PLC0415

    raise typer.Exit(list_all())


@app.command()
def schema() -> None:
    """Print the JSON schema of the experiment file."""
    import json  # noqa: PLC0415

    from experiments.schema import schema as made  # noqa: PLC0415

    typer.echo(json.dumps(made(), indent=2))


@app.command()
def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME...]", help="start, codec, virtual, process, world, encounters, safety or intruders."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what this machine can do, each figure beside a baseline."""
    from tools.bench import command  # noqa: PLC0415

    raise typer.Exit(command(names or [], as_json=as_json))


@app.command()
def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help="takeoff, start, hold, land or stop.")],
    robots: Annotated[list[str] | None, typer.Argument(metavar="[ROBOT...]", help="All, if none is named.")] = None,
    *,
    connect: Connect = None,
    realm: Annotated[str, typer.Option(metavar="NAME", help="First chunk of the keys.")] = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Tell robots that were started by hand what to do."""
    from tools.order import command  # noqa: PLC0415

    raise typer.Exit(command(what, robots or [], connect=_routers(connect, lab), realm=realm, identity=identity))


@app.command(name="world-order")
def world_order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help="pause, resume, step, reset, spawn or remove.")],
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Of the robot or obstacle; reset without one resets all.")
    ] = None,
    *,
    steps: Annotated[int, typer.Option(min=1, help="Ticks of a step.")] = 1,
    kind: Annotated[str | None, typer.Option(help="Of a new robot.")] = None,
    at: Annotated[tuple[float, float] | None, typer.Option(metavar="X Y", help="Where it is put [m].")] = None,
    yaw: Annotated[float, typer.Option(help="Of a robot that is put in [rad].")] = 0.0,
    obstacle: Annotated[
        str | None, typer.Option(metavar="JSON", help='Puts in an obstacle, such as \'{"radius": 0.1, "at": [0, 1]}\'.')
    ] = None,
    connect: Connect = None,
    realm: Annotated[str, typer.Option(metavar="NAME", help="First chunk of the keys.")] = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Tell a running world what to do."""
    from tools.world import command  # noqa: PLC0415

    raise typer.Exit(
        command(
            what,
            name,
            steps=steps,
            kind=kind,
            at=at,
            yaw=yaw,
            obstacle=obstacle,
            connect=_routers(connect, lab),
            realm=realm,
            identity=identity,
        )
    )


hosts: Final = typer.Typer(help="Other machines of an experiment.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(hosts, name="hosts")
On = Annotated[
    list[str] | None, typer.Option(metavar="HOST|TAG", help="Only this host, or those with this tag; may be repeated.")
]


@hosts.command(name="check")
def hosts_check(file: File, settings: Settings = None, on: On = None) -> None:
    """Say whether each host can take part: version, clock, devices, router."""
    from tools.hosts import check as command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], only=on or []))


@hosts.command(name="install")
def hosts_install(file: File, settings: Settings = None, on: On = None) -> None:
    """Put this zenpark on every host that has another or none."""
    from tools.hosts import install as command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], only=on or []))


app.add_typer(keys, name="keys")


@app.command()
def echo(
    key: KeyExpression,
    *,
    connect: Connect = None,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after so many samples.")] = None,
    seconds: Seconds = None,
    lab: Lab = None,
    identity: As = "observer",
) -> None:
    """Print what is said on a key, the last poses first."""
    from tools.network import echo as listen  # noqa: PLC0415

    listen(key, _routers(connect, lab), count=count, seconds=seconds, identity=identity)


@app.command()
def hz(
    key: KeyExpression,
    connect: Connect = None,
    seconds: Seconds = None,
    lab: Lab = None,
    identity: As = "observer",
) -> None:
    """Print how often something is said on a key."""
    from tools.network import hz as measure  # noqa: PLC0415

    measure(key, _routers(connect, lab), seconds=seconds, identity=identity)


@app.command()
def estop(
    connect: Connect = None,
    realm: Annotated[str, typer.Option(metavar="NAME", help="First chunk of the keys.")] = "park",
    reason: Annotated[str, typer.Option(metavar="TEXT", help="Said with it.")] = "zenpark estop",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Cut the motors of every robot, wherever it is."""
    from tools.estop import command  # noqa: PLC0415

    raise typer.Exit(command(connect=_routers(connect, lab), realm=realm, reason=reason, who=identity))


def _routers(connect: list[str] | None, lab: str | None) -> list[str]:
    from agents.lab import secured  # noqa: PLC0415

    return secured(connect or [], lab)


def _explained() -> tuple[type[BaseException], ...]:
    return tuple(getattr(sys.modules[module], name) for module, name in EXPLAINED if module in sys.modules)


def main() -> None:
    """Runs a command. Exit codes: its own, 2 for what the user can mend, 130 for Ctrl-C."""
    try:
        app()
    except _explained() as error:
        print(f"zenpark: {error}", file=sys.stderr)
        sys.exit(2)
