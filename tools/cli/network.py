"""Commands that look at a running experiment, or tell it something."""

from __future__ import annotations

from typing import Annotated, Final

import typer

from tools.cli.options import As, AsJson, Connect, KeyExpression, Lab, Realm, Seconds, routers

app: Final = typer.Typer()


@app.command()
def order(
    what: Annotated[str, typer.Argument(metavar="ORDER", help="takeoff, start, hold, land or stop.")],
    robots: Annotated[list[str] | None, typer.Argument(metavar="[ROBOT...]", help="All, if none is named.")] = None,
    *,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Tell robots that were started by hand what to do."""
    from tools.commands.orders import order_by_hand  # noqa: PLC0415

    raise typer.Exit(order_by_hand(what, robots or [], connect=routers(connect, lab), realm=realm, identity=identity))


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
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Tell a running world what to do."""
    from tools.commands.orders import world_order  # noqa: PLC0415

    raise typer.Exit(
        world_order(
            what,
            name,
            steps=steps,
            kind=kind,
            at=at,
            yaw=yaw,
            obstacle=obstacle,
            connect=routers(connect, lab),
            realm=realm,
            identity=identity,
        )
    )


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
    from tools.commands.network import echo as listen  # noqa: PLC0415

    listen(key, routers(connect, lab), count=count, seconds=seconds, identity=identity)


@app.command()
def hz(
    key: KeyExpression,
    connect: Connect = None,
    seconds: Seconds = None,
    lab: Lab = None,
    identity: As = "observer",
) -> None:
    """Print how often something is said on a key."""
    from tools.commands.network import hz as measure  # noqa: PLC0415

    measure(key, routers(connect, lab), seconds=seconds, identity=identity)


@app.command()
def estop(
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Only at this router; may be repeated. [all runs of this machine]"),
    ] = None,
    realm: Annotated[str | None, typer.Option(metavar="NAME", help="First chunk of the keys. [the run's]")] = None,
    reason: Annotated[str, typer.Option(metavar="TEXT", help="Said with it.")] = "zenpark estop",
    lab: Lab = None,
    identity: Annotated[
        str | None, typer.Option("--as", metavar="NAME", help="Whose certificate, in a lab. [the run's operator]")
    ] = None,
) -> None:
    """Cut the motors of every robot of every run of this machine, or at a router."""
    from tools.commands.estop import command  # noqa: PLC0415

    raise typer.Exit(command(connect=routers(connect, lab), realm=realm, reason=reason, who=identity))


@app.command()
def runs(as_json: AsJson = False) -> None:
    """Show which runs are up on this machine: routers, robots, since when, folders."""
    from tools.commands.estop import runs as show  # noqa: PLC0415

    raise typer.Exit(show(as_json=as_json))
