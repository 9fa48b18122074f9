"""Arguments and options that several commands share."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar, get_type_hints

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

from agents.errors import ExplainedError
from tools import completion
from tools.terminal import say

if TYPE_CHECKING:
    import zenoh

Given = TypeVar("Given", str | None, list[str], list[str] | None)

WIDEST: Final = 110  # columns of print
CONNECT: Final = "ZENPARK_CONNECT"  # environment: default of --connect, endpoints with spaces between them
PANELS: Final = {
    "Experiments": "new check explain run sweep report export list import course mark clean",
    "Watch": "view top runs keys echo",
    "Act": "robot world estop",
    "By hand": "router agent centre twin bridge",
    "Lab": "preflight hosts lab cameras turtlebot",
    "Set-up": "install hardware docs test",
}


class _Coercion:
    """Value of a parameter as its type; by typer's pydantic (70 ms of imports) only where it is not already."""

    def __init__(self, build: Any) -> None:  # noqa: ANN401 - `get_runtime_param` of a parameter of typer's private click
        self._build = build

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:  # noqa: ANN401 - likewise
        """Coerce a value; raises typer.BadParameter for one that is not of the type."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        wanted = param.type_descriptor.annotation
        if type(value) is wanted:  # a text, or a default
            return value
        if wanted == list[str] and isinstance(value, list | tuple):
            return list(value)
        return self._build().coerce(value, param=param, ctx=ctx)


def _quick(parameters: list[Any]) -> list[Any]:
    for each in parameters:
        if "get_runtime_param" not in vars(each):
            each.get_runtime_param = partial(_Coercion, each.get_runtime_param)
    return parameters


class ZenparkCommand(TyperCommand):
    """A command that imports pydantic for the numbers and paths that are given alone."""

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401 - of typer's private click
        """Parameters, that of help included."""
        return _quick(super().get_params(ctx))


class Group(TyperGroup):
    """Commands of one subject; help shows the whole first sentence of each, those of zenpark itself in panels."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401 - of typer's private click
        """Command of the first word; of hidden ones none is suggested for a wrong word."""
        if args[0] not in self.commands:
            self.commands = {name: each for name, each in self.commands.items() if not each.hidden}
        return super().resolve_command(ctx, args)

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401 - of typer's private click
        """Options of the group itself."""
        return _quick(super().get_params(ctx))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - of typer's private click
        """Write the commands into the help."""
        shown = {name: each for name, each in self.commands.items() if not each.hidden}
        panels = {title: names.split() for title, names in PANELS.items()} if ctx.parent is None else {}
        left = [name for name in shown if not any(name in names for names in panels.values())]
        for title, names in {**panels, "Commands": left}.items():
            if rows := [(name, (shown[name].help or "").partition("\n")[0]) for name in names if name in shown]:
                with formatter.section(title):
                    formatter.write_dl(rows)


def group(text: str) -> typer.Typer:
    """An empty group of commands with this help."""
    return typer.Typer(
        cls=Group, help=text, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
    )


def example(*lines: str) -> str:
    """Lines behind `./zenpark` that a command's help ends with, each as it can be typed."""
    title = "Examples" if len(lines) > 1 else "Example"
    return "\b\n" + "\n".join([f"{title}:", *(f"  ./zenpark {line}" for line in lines)])


File = Annotated[
    str,
    Argument(
        metavar="FILE", help="Experiment file, or name of a ready-made one.", autocompletion=completion.experiments
    ),
]
Connect = Annotated[
    list[str] | None,
    Option(
        metavar="ENDPOINT",
        envvar=CONNECT,
        help="A router; may be repeated. @FILE: those of a run. [tcp/127.0.0.1:7447]",
    ),
]
Lab = Annotated[str | None, Option(metavar="FOLDER", help="Certificates of a lab (`./zenpark lab init`).")]
As = Annotated[str, Option("--as", metavar="NAME", help="Name of the certificate, in a lab.")]
Settings = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="PATH=VALUE",
        help="Change a value of the file; may be repeated.",
        autocompletion=completion.paths,
    ),
]
AsJson = Annotated[bool, Option("--json", help="Print the result as JSON.")]
KeyExpression = Annotated[str, Argument(metavar="KEY", help="Key expression, such as park/*/pose.")]
Seconds = Annotated[float | None, Option(min=0.0, help="End after this time [s].")]


def plain(given: Given) -> Given:
    """Names on the command line, which become parts of keys; raises typer.BadParameter for one that is none, as `*`."""
    for name in [given] if isinstance(given, str) else given or ():
        if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise typer.BadParameter(f"'{name}' cannot be a name; use letters, digits and _")
    return given


Realm = Annotated[str, Option(metavar="NAME", help="First chunk of the keys.", callback=plain)]
RealmOfRun = Annotated[
    str | None, Option("--realm", metavar="NAME", help="First chunk of the keys. [the run's]", callback=plain)
]
Case = Annotated[
    str | None, Option(metavar="NAME", help="A case of the file. [the first]", autocompletion=completion.cases)
]
Cases = Annotated[
    list[str] | None,
    Option("--case", metavar="NAME", help="Only this case; may be repeated.", autocompletion=completion.cases),
]
Lifeline = Annotated[bool, Option("--lifeline", help="End when standard input ends or falls silent.")]


def at_home(path: str | None) -> str | None:
    """A path on the command line with its `~`, which a shell leaves in quotes and behind `=`."""
    return path and os.path.expanduser(path)  # noqa: PTH111 - a name of no user stays


Out = Annotated[str | None, Option(metavar="FOLDER", help="Folder for the results. [runs/...]", callback=at_home)]
Bodies = Annotated[
    str | None, Option(metavar="twin|world|protocol", help="Bodies: a twin per robot, one world, or protocol twins.")
]
Here = Annotated[bool, Option("--here", help="Run all robots on this machine, ignoring [hosts].")]
Report = Annotated[bool, Option(help="Write the report; `./zenpark report FOLDER --pdf` adds its figures as PDF.")]
Anyway = Annotated[bool, Option("--anyway", help="Run it in spite of errors of the check.")]
OpenReport = Annotated[bool, Option("--open", help="Open it in the browser.")]


def with_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command each field of its last parameter, a dataclass, as an option of its own."""
    signature = inspect.signature(command, eval_str=True)
    *own, last = signature.parameters.values()
    fields = dataclasses.fields(last.annotation)
    types = get_type_hints(last.annotation, include_extras=True)

    @wraps(command)
    def called(*args: object, **given: object) -> int:
        shared = {field.name: given.pop(field.name) for field in fields if field.name in given}
        return command(*args, **given, **{last.name: last.annotation(**shared)})

    more = [last.replace(name=each.name, default=each.default, annotation=types[each.name]) for each in fields]
    called.__dict__["__signature__"] = signature.replace(parameters=[*own, *more])
    called.__annotations__ = {each.name: each.annotation for each in (*own, *more)}
    return called


def warn(lines: Sequence[str]) -> None:
    """Print notes for the user on standard error."""
    say(*(f"zenpark: {line}" for line in lines), to=sys.stderr)


def open_in_browser(address: str, by_hand: str = "") -> None:
    """Open a page, or tell that there is no browser, and which address is opened `by_hand`."""
    import webbrowser

    if not webbrowser.open(address):
        warn([f"no browser was found here: open {by_hand or address} by hand"])


def json_text(value: Any) -> str:  # noqa: ANN401 - whatever JSON can hold, structs included
    """A result as JSON: what every command prints with `--json`; NaN is null, a path its text."""
    import msgspec

    text = msgspec.json.encode(value, enc_hook=lambda other: other.item() if hasattr(other, "item") else str(other))
    return msgspec.json.format(text, indent=2).decode()


def print_json(value: Any) -> None:  # noqa: ANN401 - likewise
    print(json_text(value))


def print_result(result: Any, *lines: str, as_json: bool) -> None:  # noqa: ANN401 - as `print_json`
    """Print what a command has done: as JSON for scripts, as lines for people."""
    if as_json:
        print_json(result)
    else:
        say(*lines)


def routers(connect: list[str] | None, lab: str | None) -> list[str]:
    """Endpoints as given on the command line, with the certificates of a lab where one is named.

    Raises EndpointError if a file of endpoints cannot be read, LabError if one of them asks for no certificate.
    """
    from agents.network.lab import secured
    from experiments.definition.endpoints import read_endpoints

    return secured(read_endpoints(connect or []), lab)


@dataclass(frozen=True)
class Place:
    """Routers at which a command looks or acts."""

    endpoints: list[str]
    realm: str = "park"
    strange: bool = False  # True if no run or router of this user is known there


def place(connect: list[str] | None, lab: str | None, *, acting: bool = False) -> Place:
    """The place of the command line, else of the newest run or router of this user on this machine.

    Without any, the usual router of this machine. It is another one's: who is `acting` has to name it, and to choose
    where several are up. Raises ExplainedError then, and errors as `routers`.
    """
    from agents.network.endpoints import DEFAULT_ENDPOINT
    from agents.network.lab import options
    from experiments.real_time.hosts import run_registry

    if given := routers(connect, lab):
        return Place(given)
    up = [run for run in run_registry.runs() if run.alive]
    if len(up) > 1:
        shown = "".join(f"\n  {run.words}: {options(run.endpoints[0])}" for run in reversed(up))
        if acting:
            raise ExplainedError(f"{len(up)} runs and routers are up: choose one{shown}")
        warn([f"{len(up)} runs and routers are up; this is the newest one{shown}"])
    if up:
        return Place(up[-1].endpoints, up[-1].realm)
    if acting:
        raise ExplainedError(
            "no run or router of yours is up on this machine: start one (`./zenpark run robotic-park`), or name "
            f"the router of another user (--connect {DEFAULT_ENDPOINT})"
        )
    return Place([DEFAULT_ENDPOINT], strange=True)


@contextmanager
def session(
    name: str,
    where: Place,
    identity: str,
    wait_s: float = 1.0,  # a router of this machine answers at once
) -> Iterator[zenoh.Session]:
    """A session of a command at a place; a note says when it is a stranger's."""
    from agents.network.endpoints import describe
    from agents.network.session import open_session

    with open_session(where.endpoints, name=f"zenpark {name}", wait_s=wait_s, identity=identity) as opened:
        if where.strange:
            warn([f"no run or router of yours is up: this one, at {describe(where.endpoints)}, is none of yours"])
        yield opened


def known_words(option: str, given: Sequence[str], known: Collection[str]) -> list[str]:
    """Words behind an option, also with commas between them; raises DocumentError for one that is not `known`."""
    from agents.errors import did_you_mean
    from experiments.file.problems import refusal

    words = [word.strip() for part in given for word in part.split(",") if word.strip()]
    for word in words:
        if word not in known:
            near = did_you_mean(word, known)
            hint = f"{near}; " if near.startswith("did you mean") else ""
            raise refusal(f"{option} {word}", "is not known", f"{hint}there are: {', '.join(known)}")
    return words


def check_bodies(bodies: str | None) -> None:
    """Raises DocumentError for a word behind `--bodies` that there is not."""
    from experiments.definition.bodies import BODIES
    from experiments.file.problems import refusal

    if bodies not in (None, *BODIES):
        raise refusal(f"--bodies {bodies}", "is not known", f"there are: {', '.join(BODIES)}")
