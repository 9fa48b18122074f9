"""Commands for the other machines of an experiment."""

from __future__ import annotations

from typing import Annotated, Final

import typer

from tools.cli.options import File, Lab, Settings

app: Final = typer.Typer(help="Other machines of an experiment.", no_args_is_help=True, rich_markup_mode=None)
On = Annotated[
    list[str] | None, typer.Option(metavar="HOST|TAG", help="Only this host, or those with this tag; may be repeated.")
]


@app.command(name="check")
def check(file: File, settings: Settings = None, on: On = None, lab: Lab = None) -> None:
    """Say whether each host can take part: version, clock, devices, certificates, router."""
    from tools.commands.hosts import check as command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], only=on or [], lab=lab))


@app.command(name="install")
def install(file: File, settings: Settings = None, on: On = None, lab: Lab = None) -> None:
    """Put this zenpark on every host that has another or none, and in a lab the certificates of its robots."""
    from tools.commands.hosts import install as command  # noqa: PLC0415

    raise typer.Exit(command(file, settings=settings or [], only=on or [], lab=lab))
