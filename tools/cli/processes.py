"""Commands that are processes of an experiment: robots, routers, worlds, stand-ins, bridges."""

from __future__ import annotations

from typing import Annotated, Final

import typer

from tools.cli.options import As, Bodies, Case, Connect, File, Lab, Lifeline, Realm, routers

app: Final = typer.Typer()


@app.command()
def agent(
    file: File,
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="The robots of this process.")],
    *,
    case: Case = None,
    connect: Connect = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", help="Land and end when standard input ends or falls silent.")
    ] = False,
    clock_correction: Annotated[
        float, typer.Option(metavar="SECONDS", help="Added to this machine's clock to get the conductor's.")
    ] = 0.0,
    once: Annotated[bool, typer.Option("--once", help="End when down after the experiment.")] = False,
    realm: Realm = "park",
    lab: Lab = None,
) -> None:
    """Be one robot of an experiment, or several that share a device.

    FILE "join" waits for whatever is run next; "-" is a line of JSON on standard input.
    """
    from experiments.real_time.processes.robot import fly  # noqa: PLC0415

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
    from experiments.real_time.hosts.station import serve  # noqa: PLC0415

    raise typer.Exit(serve())


@app.command()
def router(
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="The experiment whose rights it enforces, in a lab.")
    ] = None,
    *,
    listen: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Without a lab on loopback; may be repeated. [tcp/127.0.0.1:7447]"),
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Another router to be linked with; may be repeated.")
    ] = None,
    lifeline: Lifeline = False,
    lab: Lab = None,
    bodies: Bodies = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the configuration for a zenohd that is to do the same.")
    ] = False,
) -> None:
    """Run the Zenoh router that the robots meet at."""
    from tools.commands.router import command  # noqa: PLC0415

    raise typer.Exit(
        command(
            file,
            listen=listen or [],
            link=connect or [],
            lifeline=lifeline,
            lab=lab,
            bodies=bodies,
            print_config=print_config,
        )
    )


@app.command()
def centre(
    file: File,
    *,
    case: Case = None,
    connect: Connect = None,
    lifeline: Lifeline = False,
    lab: Lab = None,
) -> None:
    """Be the centre of an experiment: decide for the robots that it guides."""
    from experiments.real_time.processes.centre import serve  # noqa: PLC0415

    raise typer.Exit(serve(file, case=case, connect=connect or [], lifeline=lifeline, lab=lab))


@app.command()
def world(
    file: File,
    *,
    case: Case = None,
    connect: Connect = None,
    engine: Annotated[str | None, typer.Option(metavar="NAME", help="What moves the twins. [the file's]")] = None,
    lifeline: Annotated[
        bool, typer.Option("--lifeline", help="End, after its robots, when standard input ends or falls silent.")
    ] = False,
    lab: Lab = None,
) -> None:
    """Be the world of an experiment: carry its twins, with obstacles, contacts and range sensors."""
    from experiments.real_time.processes.world import serve  # noqa: PLC0415

    raise typer.Exit(serve(file, case=case, connect=connect or [], lifeline=lifeline, engine=engine, lab=lab))


@app.command()
def twin(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="crazyflie, tello, khepera4 or turtlebot3.")],
    *,
    count: Annotated[int, typer.Option(min=1, max=99, help="How many.")] = 1,
    connect: Connect = None,
    faults: Annotated[str, typer.Option(metavar="JSON", help="What goes wrong, such as '{\"loss\": 0.05}'.")] = "{}",
    device: Annotated[str, typer.Option(metavar="JSON", help="Settings of the device.")] = "{}",
    lab: Lab = None,
    identity: As = "twin",
) -> None:
    """Stand in for hardware: protocol twins, to which vendor libraries connect."""
    from experiments.real_time.processes.protocol_twins import command  # noqa: PLC0415

    endpoints = routers(connect, lab)
    raise typer.Exit(command(kind, count, faults=faults, device=device, connect=endpoints, identity=identity))


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
