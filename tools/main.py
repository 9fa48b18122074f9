"""The command line. A command imports its needs when it runs, so that help and the emergency stop are quick."""

from __future__ import annotations

import errno
import inspect
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from typing import Annotated, Final

import typer
from typer import Option
from typer.models import CommandInfo

from agents.errors import ExplainedError
from tools.commands import author, check, explain, hosts, lab, network, orders, processes, results, run, sweep, view
from tools.options import Group, ZenparkCommand, example, print_json, warn


def _exit(code: object, **_: object) -> None:
    raise typer.Exit(code if isinstance(code, int) else 0)


app: Final = typer.Typer(
    name="zenpark",
    cls=Group,
    help="Distributed experiments with several robots, on Zenoh.",
    no_args_is_help=True,
    result_callback=_exit,
    rich_markup_mode=None,  # rich help costs 100 ms at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _module in (run, results, view, sweep, check, explain, author, processes, network, orders):
    app.add_typer(_module.app)
app.add_typer(hosts.app, name="hosts")
app.add_typer(lab.app, name="lab")
app.add_typer(orders.robot_app, name="robot")
app.add_typer(hosts.turtlebot_app, name="turtlebot")
app.add_typer(orders.world_app, name="world")
app.add_typer(processes.cameras_app, name="cameras")

# what `./zenpark` itself does, before Python's packages are there
LAUNCHER: Final = {
    "install": "Add plug-ins of your own, or libraries for notebooks.",
    "hardware": "Add the libraries that real robots need.",
    "docs": "Serve the documentation site, or build it.",
    "test": "Check the project: lint, types and tests.",
}


def _launched(name: str) -> Callable[[typer.Context], int]:
    def command(context: typer.Context) -> int:
        text = f"`{name}` is done by the script ./zenpark of the checkout, not by this command"
        print(f"zenpark: {text}; in its folder: ./zenpark {name} {' '.join(context.args)}".rstrip(), file=sys.stderr)
        return 2

    return command


for _name, _help in LAUNCHER.items():
    _given = {"allow_extra_args": True, "ignore_unknown_options": True}
    app.command(name=_name, help=_help, epilog=example(f"{_name} --help"), context_settings=_given)(_launched(_name))


NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # a disk takes no more


def _version(asked: bool) -> None:
    if asked:
        from experiments.recording.version import provenance  # noqa: PLC0415

        typer.echo(provenance().words[0])
        raise typer.Exit


@app.callback()
def _zenpark(
    version: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Show version, digest of the code and commit.")
    ] = False,
) -> None: ...


UsageError: Final[type[typer.BadParameter]] = typer.BadParameter.__mro__[
    1
]  # its own click's, which has no name in typer


def _plain(message: str) -> str:
    """The library's words for a value that an option does not take, in those of our own errors."""
    message = re.sub(r"(Did you mean '[^']*')(?:, '[^']*')+", r"\1", message)  # the nearest command
    found = re.fullmatch(r"Invalid value for '?(.+?)'?: (?:Input should (be .*?)(?:, unable to .*)?|(.*))", message)
    return message if found is None else f"{found[1]}: {f'must {found[2]}' if found[2] else found[3]}"


def _remedy(words: Sequence[str], message: str, epilog: str) -> str:
    """Remedy for a wrong use of the command `words`; of an emergency stop it says that nothing was stopped."""
    if [*words] == ["estop"] or re.match(r"no such command '(e-?)?stop\W*'", message.lower()):
        return "NOTHING WAS STOPPED: `./zenpark estop` stops all, `./zenpark robot stop NAME` one"
    examples = epilog.split("./zenpark ")[1:]
    if message.startswith("Missing argument") and examples:
        return f"for example: ./zenpark {examples[0].strip()}"
    asked = " ".join(["./zenpark", *words, "--help"])
    return f"`{asked}` shows what there is"


def _report(message: str, remedy: str = "", problems: Sequence[object] | None = None) -> None:
    """Print an error; where JSON was asked for, on standard output as JSON too."""
    warn([f"{message}{remedy}"])
    if "--json" in sys.argv:
        print_json({"ok": False, "error": message, "problems": problems or []})


COMPLETING: Final = "_ZENPARK_COMPLETE"  # environment: a shell asks for what may follow


def part_for(words: Sequence[str], whole: typer.Typer = app) -> typer.Typer:
    """The application, in which only the command of a call has parameters: those of all take 30 ms to build."""

    def outline(command: CommandInfo) -> CommandInfo:
        name = command.name or getattr(command.callback, "__name__", "")
        shown = copy(command)
        if name in words[:1]:
            shown.cls = ZenparkCommand
        else:
            shown.name, shown.help = name, command.help or inspect.getdoc(command.callback)
            shown.callback = lambda: None
        return shown

    part = copy(whole)
    part.registered_commands = [outline(command) for command in whole.registered_commands]
    part.registered_groups = [copy(group) for group in whole.registered_groups]
    for group in part.registered_groups:
        inside = words if not group.name else words[1:] if group.name in words[:1] else ()
        group.typer_instance = part_for(inside, group.typer_instance or app)
    return part


def main() -> None:
    """Run the command of the command line."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # batch systems end a sweep so: what is done is kept
    call(app if COMPLETING in os.environ else part_for(sys.argv[1:]))


def call(command: typer.Typer, name: str = "zenpark") -> None:
    """Run a command. Exit codes: its own, 2 for what the user can mend, 130 for Ctrl-C.

    Args:
        name: Words before its arguments.
    """
    try:
        try:
            code = command(prog_name=name, standalone_mode=False)
        finally:
            with suppress(BrokenPipeError):
                sys.stdout.flush()  # a full disk shows here at the latest
    except UsageError as error:
        words = [] if error.ctx is None else error.ctx.command_path.split()[1:]
        message = _plain(error.format_message())
        if error.ctx is not None and message == error.ctx.get_help():
            print(message)
        else:
            epilog = error.ctx.command.epilog or "" if error.ctx else ""
            _report(message, f"\n  {_remedy(words, message, epilog)}")
        sys.exit(2)
    except typer.Abort:
        sys.exit(130)
    except ExplainedError as error:
        _report(str(error), problems=getattr(error, "problems", None))
        sys.exit(2)
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        place = f"{error.filename}: " if error.filename else ""
        _report(f"{place}cannot be written: {error.strerror}", "\n  make room there, or choose another place")
        sys.exit(2)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit of a plug-in is no success
        registry = sys.modules.get("agents.plugins.registry")  # not loaded: no plug-in is
        if registry is None or (place := registry.culprit(error)) is None:
            raise
        _report(f"{place}: {type(error).__name__}: {error}")
        sys.exit(2)
    network = sys.modules.get("agents.network.shutdown")  # not loaded: no session was open
    (sys.exit if network is None else network.end_process)(code)
