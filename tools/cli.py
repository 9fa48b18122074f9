"""The command line: signatures and help only. What a command does is imported when it runs, so that help is quick."""

from __future__ import annotations

import sys
from typing import Annotated, Final

import typer

from tools import commands_hosts, commands_network, commands_processes, commands_runs, keys, robot

app: Final = typer.Typer(
    name="zenpark",
    help="Distributed experiments with several robots, on Zenoh.",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich help costs 100 ms at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _group in (commands_runs, commands_processes, commands_network):
    app.add_typer(_group.app)
app.add_typer(commands_hosts.app, name="hosts")
app.add_typer(keys.app, name="keys")
app.add_typer(robot.app, name="robot", help="Change the robots of a run that is under way.")

# The errors that explain themselves, by the module that defines them: one that was raised has its module loaded,
# so that nothing needs to be imported to recognise it.
EXPLAINED: Final = (
    ("agents.session", "EndpointError"),
    ("agents.lab", "LabError"),
    ("agents.session", "Unreachable"),
    ("agents.body", "BodyError"),
    ("agents.naming", "NameTaken"),
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


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # noqa: PLC0415

        typer.echo(f"zenpark {version('zenpark')}")
        raise typer.Exit


@app.callback()
def _zenpark(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")] = False,
) -> None: ...


def _explained() -> tuple[type[BaseException], ...]:
    return tuple(getattr(sys.modules[module], name) for module, name in EXPLAINED if module in sys.modules)


def main() -> None:
    """Runs a command. Exit codes: its own, 2 for what the user can mend, 130 for Ctrl-C."""
    try:
        app()
    except _explained() as error:
        print(f"zenpark: {error}", file=sys.stderr)
        sys.exit(2)
