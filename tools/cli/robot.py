"""`zenpark robot`: pause, resume, remove, restart, replace and add robots of a run that is under way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Final

import typer

from tools.cli.options import As, Connect, Lab, Realm, routers

if TYPE_CHECKING:
    from agents.network import messages

app: Final = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, no_args_is_help=True)

Names = Annotated[list[str], typer.Argument(metavar="NAME...", help="Robots of the run.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="A robot of the run.")]


SAYS: Final[Mapping[messages.ChangeKind, str]] = {
    "pause": "Let robots hold where they are; the others go on.",
    "resume": "Let robots go on that were paused.",
    "remove": "Land robots and end their processes; the others go on without them.",
    "restart": "Start robots again, whether they fly, were removed or crashed; they join the run under way.",
    "add": "Let robots join that are on standby, were missing at the start, or were started by hand.",
}


def _named(what: messages.ChangeKind) -> Callable[..., None]:
    """A command that asks for one change of the robots that are named."""

    def change(
        names: Names, *, connect: Connect = None, realm: Realm = "park", lab: Lab = None, identity: As = "operator"
    ) -> None:
        from tools.commands.orders import robot_order  # noqa: PLC0415

        raise typer.Exit(robot_order(what, names, connect=routers(connect, lab), realm=realm, identity=identity))

    return change


for _what, _says in SAYS.items():
    app.command(name=_what, help=_says)(_named(_what))


@app.command()
def replace(
    name: Name,
    *,
    spare: Annotated[str | None, typer.Option("--with", metavar="SPARE", help="A spare of the file.")] = None,
    body: Annotated[str | None, typer.Option(metavar="URI", help="Address of another body.")] = None,
    at: Annotated[
        tuple[float, float] | None, typer.Option(metavar="X Y", help="Where a twin starts [m]; else as the file says.")
    ] = None,
    yaw: Annotated[float, typer.Option(help="Of a twin that is put somewhere [rad].")] = 0.0,
    connect: Connect = None,
    realm: Realm = "park",
    lab: Lab = None,
    identity: As = "operator",
) -> None:
    """Let another body take over a robot's name, links and plan; a spare of its kind if nothing else is said."""
    from tools.commands.orders import robot_order  # noqa: PLC0415

    raise typer.Exit(
        robot_order(
            "replace",
            [name],
            spare=spare,
            body=body,
            at=at,
            yaw=yaw,
            connect=routers(connect, lab),
            realm=realm,
            identity=identity,
        )
    )
