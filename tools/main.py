"""The command line. A command imports its needs when it runs, so that help and the emergency stop are quick."""

from __future__ import annotations

import sys
from typing import Annotated, Final

import typer

from tools.bench import bench
from tools.commands import check, estop, hosts, lab, network, orders, processes, run, sweep, view
from tools.reliability import chaos, soak


def _exit(code: object, **_: object) -> None:
    """A command returns its exit code; None is 0."""
    raise typer.Exit(code if isinstance(code, int) else 0)


app: Final = typer.Typer(
    name="zenpark",
    help="Distributed experiments with several robots, on Zenoh.",
    no_args_is_help=True,
    result_callback=_exit,
    rich_markup_mode=None,  # rich help costs 100 ms at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _module in (run, view, sweep, check, soak, chaos, bench, processes, network, orders, estop):
    app.add_typer(_module.app)
app.add_typer(hosts.app, name="hosts")
app.add_typer(lab.app, name="keys")
app.add_typer(orders.robot_app, name="robot", help="Change the robots of a run that is under way.")

# The errors that explain themselves, by the module that defines them: one that was raised has its module loaded,
# so that nothing needs to be imported to recognise it.
EXPLAINED: Final = (
    ("agents.network.endpoints", "EndpointError"),
    ("agents.network.lab", "LabError"),
    ("agents.network.session", "Unreachable"),
    ("agents.body.interface", "BodyError"),
    ("agents.network.name_ownership", "NameTaken"),
    ("agents.plugins.registry", "PluginError"),
    ("experiments.file.problems", "DocumentError"),
    ("experiments.recording.reader", "RecordingError"),
    ("experiments.report.export", "ExportError"),
    ("experiments.real_time.conductor.conductor", "RunFailed"),
    ("experiments.real_time.hosts.hosts", "HostError"),
    ("experiments.virtual_time.conductor", "Stuck"),
    ("experiments.sweep.workers", "SweepError"),
    ("experiments.real_time.conductor.support", "StandInError"),
    ("tools.commands.orders", "WorldOrderError"),
    ("tools.commands.network", "KeyExpressionError"),
    ("tools.commands.view", "ViewError"),
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


UsageError: Final[type[typer.BadParameter]] = typer.BadParameter.__mro__[
    1
]  # its own click's, which has no name in typer


def main() -> None:
    """Run a command. Exit codes: its own, 2 for what the user can mend, 130 for Ctrl-C."""
    try:
        sys.exit(app(prog_name="zenpark", standalone_mode=False))
    except UsageError as error:
        words = [] if error.ctx is None else error.ctx.command_path.split()[1:]
        message = error.format_message()
        if error.ctx is not None and message == error.ctx.get_help():
            print(message)
        else:
            asked = " ".join(["./zenpark", *words, "--help"])
            remedy = f"`{asked}` shows what there is"
            print(f"zenpark: {message}\n  {remedy}", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        sys.exit(130)
    except _explained() as error:
        print(f"zenpark: {error}", file=sys.stderr)
        sys.exit(2)
