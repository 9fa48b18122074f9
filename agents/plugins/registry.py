"""Registry of plug-ins by entry points: bodies, kinds, readers of motion capture, triggers, laws, planners and others.

A trigger, law, planner, avoidance or engine is a frozen `msgspec.Struct` of its parameters; a body is a class, made
with a `agents.body.interface.BodyRequest`; a kind of robot is an object `agents.body.kinds.Kind`. Any distribution may
add one, for example under `[project.entry-points."zenpark.triggers"]` in its pyproject.toml. Structs of parameters may
stand in a file as well, see `agents.plugins.files`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib.metadata import Distribution, EntryPoint, EntryPoints, entry_points
from pathlib import Path
from traceback import walk_tb
from types import FrameType
from typing import Any, ClassVar, Final, Literal, Protocol, get_args, get_origin, get_type_hints

import msgspec

from agents.errors import ExplainedError, did_you_mean
from agents.plugins import files

BODIES: Final = "zenpark.bodies"
ROBOTS: Final = "zenpark.kinds"  # kinds of robots
TRIGGERS: Final = "zenpark.triggers"
LAWS: Final = "zenpark.laws"
PREDICTORS: Final = "zenpark.predictors"
PLANNERS: Final = "zenpark.planners"
AVOIDANCES: Final = "zenpark.avoidances"
ENGINES: Final = "zenpark.engines"  # physics of the twins of a world
STRUCTS: Final = (TRIGGERS, PREDICTORS, LAWS, PLANNERS, AVOIDANCES, ENGINES)  # groups with parameters in a file
CHOSEN: Final = (ROBOTS, *STRUCTS)  # groups with names in a file
METRICS: Final = "zenpark.metrics"  # measured quantities, without parameters
FACE: Final = "zenpark"  # module of the names that plug-ins import
NAMED_BY_FILE: Final = (*STRUCTS, METRICS)  # groups with classes that a file beside the experiment may hold
POSITIONING: Final = "zenpark.positioning"  # readers of motion capture, by the schemes of their addresses
DEVICES: Final = "zenpark.devices"  # protocol twins: simulated far ends of the protocols of bodies
# Base of the classes of each group, as `module:class`: what zenpark asks of a plug-in stands there, with its default.
BASES: Final = {
    BODIES: "agents.body.interface:Body",
    TRIGGERS: "agents.plugins.triggers:Trigger",
    LAWS: "agents.plugins.law:Law",
    PREDICTORS: "agents.plugins.predictors:Predictor",
    PLANNERS: "agents.plugins.planners:Planner",
    AVOIDANCES: "agents.plugins.avoidance:Avoidance",
    ENGINES: "twins.engines.engine:EngineFactory",
    POSITIONING: "agents.body.capture_reader:CaptureReader",
    METRICS: "experiments.metrics.metric:Metric",
}


class _Groups(Protocol):
    """Result of `entry_points()`; Python 3.12 changed its type."""

    def select(self, *, group: str) -> EntryPoints: ...


class PluginError(ExplainedError, ValueError):
    """A registered plug-in cannot be used."""


class UnknownPlugin(PluginError):
    """No plug-in has this name."""


def names(group: str) -> list[str]:
    """Names registered in an entry-point group, sorted."""
    return sorted(registered(group))


def load(group: str, name: str) -> Any:  # noqa: ANN401 - what it is depends on the group
    """The object registered under a name.

    Raises UnknownPlugin with the nearest name, or all of them. Raises PluginError, with the distributions, if two
    register different objects under this name, or if the module fails to import. Raises it, too, for an object that is
    no class derived from the base of the group.
    """
    if files.is_choice(name) and group in NAMED_BY_FILE:
        return _fitting(group, name, _in_file(name))
    known = registered(group)
    what = group.rpartition(".")[2]
    if name not in known:
        raise UnknownPlugin(f"no {name!r} among the {what}; {did_you_mean(name, sorted(known)) or 'none is installed'}")
    entry, *rivals = known[name]
    if rivals:
        owners = " and ".join(_origin(each) for each in known[name])
        raise PluginError(f"{name!r} among the {what} is ambiguous: {owners}; give one of them another name")
    try:
        plugin = entry.load()
    except _IMPORT_FAILURES as error:
        raise PluginError(f"{_origin(entry)} fails to import: {_reason(error)}") from error
    return _fitting(group, name, plugin)


def _fitting(group: str, name: str, plugin: Any) -> Any:  # noqa: ANN401 - likewise
    """The plug-in, if it is a class as the base of its group asks; else raises PluginError."""
    if group in BASES and (fault := _fault_of(plugin, BASES[group])):
        raise PluginError(f"{_origin_of(group, name)} {fault}")
    return plugin


def _fault_of(plugin: Any, path: str) -> str:  # noqa: ANN401 - likewise
    """Parts that a plug-in lacks of the base at a `path`, `module:name`; empty for one that lacks nothing."""
    base = find(path, "base of a plug-in")
    if not (isinstance(plugin, type) and issubclass(plugin, base)):
        return f"must be a class that inherits from {FACE}.{base.__name__}"
    if missing := [name for name in dir(plugin) if getattr(getattr(plugin, name), "__isabstractmethod__", False)]:
        return f"lacks the methods {', '.join(missing)}"
    values = ((name, getattr(plugin, name), allowed) for name, allowed in _literals(base).items())
    return next(
        (f"says {name} = {value!r}, none of {allowed}" for name, value, allowed in values if value not in allowed), ""
    )


def _in_file(name: str) -> Any:  # noqa: ANN401 - likewise
    """The class in a file; raises PluginError, with the line, if it cannot be loaded."""
    try:
        return files.load(name)
    except _IMPORT_FAILURES as error:
        file = Path(name.partition(":")[0]).name
        lines = [f", line {line}" for frame, line in walk_tb(error.__traceback__)
                 if Path(frame.f_code.co_filename).name == file]  # fmt: skip
        words = _reason(error) + "".join(lines[-1:])
        raise PluginError(f"plug-in {files.plain(name)!r} cannot be loaded: {words}") from error


def module(group: str, name: str) -> str:
    """Name of the module in which a plug-in that was loaded stands; raises KeyError for one that is not registered."""
    return registered(group)[name][0].module


def unusable(use: Callable[[str, str], object], groups: Iterable[str] = CHOSEN) -> list[str]:
    """Reasons why plug-ins that a file may name cannot be used: a line for each one that `use(group, name)` refuses."""
    lines = []
    for group in groups:
        for name in names(group):
            try:
                use(group, name)
            except PluginError as error:
                lines.append(f"left out: {' '.join(str(error).split())}; mend or uninstall it (docs/plugins.md)")
    return lines


def find(path: str, what: str) -> Any:  # noqa: ANN401 - likewise
    """The object at a `path`, `module:name`; raises PluginError, with `what` it is, if it cannot be had."""
    try:
        return EntryPoint(what, path, "").load()
    except _IMPORT_FAILURES as error:
        raise PluginError(f"{what} ({path}) fails to import: {type(error).__name__}: {error}") from error


def struct(group: str, name: str) -> type[msgspec.Struct]:
    """The struct of parameters registered under a name.

    Raises as `load`, and PluginError if it is no frozen struct.
    """
    plugin = load(group, name)
    if not (isinstance(plugin, type) and issubclass(plugin, msgspec.Struct)):
        raise PluginError(f"{_origin_of(group, name)} is no msgspec.Struct; its parameters must be its fields")
    if not plugin.__struct_config__.frozen:  # one object serves all robots and seeds: what it kept would leak
        raise PluginError(
            f"{_origin_of(group, name)} can be changed, and would mix what it keeps of different robots and runs; "
            "declare it with frozen=True and keep nothing in it (triggers: MEMORY)"
        )
    return plugin


def build(group: str, choice: str | Mapping[str, Any]) -> Any:  # noqa: ANN401 - likewise
    """The plug-in of a choice such as `"periodic"` or `{"kind": "send-on-delta", "threshold": 0.01}`.

    Raises as `struct`, and msgspec.ValidationError with the path `$.parameter` of a parameter that is wrong or missing.
    """
    name, parameters = split(choice)
    return msgspec.convert(parameters, struct(group, name))


def split(choice: str | Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """A choice as its name and parameters; raises msgspec.ValidationError without a `kind` that is a text."""
    if isinstance(choice, str):
        return choice, {}
    if "kind" not in choice:
        raise msgspec.ValidationError("Object missing required field `kind`")
    kind = choice["kind"]
    if not isinstance(kind, str):
        raise msgspec.ValidationError(f"Expected `str`, got `{type(kind).__name__}` - at `$.kind`")
    return kind, {key: value for key, value in choice.items() if key != "kind"}


def culprit(error: BaseException) -> str | None:
    """The line of another distribution's plug-in in which an error came about; None if there is none."""
    for frame, line in reversed(list(walk_tb(error.__traceback__))):
        if (owner := owner_of(frame)) is not None:
            return f"{owner} failed at {files.plain(frame.f_code.co_filename)}:{line}"
    return None


def owner_of(frame: FrameType) -> str | None:
    """The plug-in of another distribution, or of a file, with the module that a frame runs; None if it is none."""
    module = frame.f_globals.get("__name__", "")
    if module.startswith(files.PREFIX):
        return f"plug-in in {Path(frame.f_code.co_filename).name}"
    owner = _owners().get(module)
    return None if owner is None else f"plug-in {module} of {owner}"


def body_name(address: str) -> str:
    """Name of the body in an address: `"radio"` of `"radio://0/80/2M"`, `"twin"` of `"twin"`."""
    return address.partition("://")[0]


def distributions(text: str | None = None) -> dict[str, str]:
    """Installed distributions with plug-ins, and their versions, except our own; with metrics, or named, if `text`."""
    words = None if text is None else {*re.findall(r"[\w.-]+", text)}
    used = [
        (entry, dist) for entry, dist in _foreign() if entry.group == METRICS or words is None or entry.name in words
    ]
    owners = {distribution_name(dist): dist.version for _, dist in used}
    return dict(sorted(owners.items()))


def _foreign() -> list[tuple[EntryPoint, Distribution]]:
    """Entry points of other distributions than ours."""
    groups = (BODIES, DEVICES, POSITIONING, METRICS, *CHOSEN)
    entries = (entry for group in groups for entry in installed().select(group=group))
    return [
        (entry, entry.dist)
        for entry in entries
        if entry.dist is not None and distribution_name(entry.dist) != "zenpark"
    ]


@cache
def _owners() -> dict[str, str]:
    """Distributions of others by the modules of their plug-ins."""
    return {entry.module: distribution_name(dist) for entry, dist in _foreign()}


@cache
def _literals(base: type) -> dict[str, tuple[object, ...]]:
    """Class variables of a base that have one of a few values, with these."""
    hints = {name: hint for name, hint in get_type_hints(base).items() if get_origin(hint) is ClassVar}
    kinds = {name: get_args(hint)[0] for name, hint in hints.items()}
    return {name: get_args(kind) for name, kind in kinds.items() if get_origin(kind) is Literal}


@cache
def distribution_name(distribution: Distribution) -> str:
    """Cached: a distribution parses its whole metadata for it."""
    return distribution.name


@cache
def installed() -> _Groups:
    """Cached, and all groups at once: reading the metadata of all installed distributions takes milliseconds."""
    return entry_points()


@cache
def registered(group: str) -> dict[str, list[EntryPoint]]:
    """Entry points of a group by name: one each, unless distributions register different objects under one name."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in installed().select(group=group):
        same = found.setdefault(entry.name, [])
        if entry.value not in {each.value for each in same}:  # a distribution may be found twice, by two paths
            same.append(entry)
    return found


def _reason(error: BaseException) -> str:
    """Reason why a module fails to import, with the nearest name of `zenpark` for an unknown one."""
    asked = re.search(r"import name '(\w+)'", str(error))
    if asked and isinstance(error, ImportError) and error.name == FACE:
        return f"{FACE} has no {asked[1]!r}; {did_you_mean(asked[1], dir(sys.modules[FACE]))}"
    if isinstance(error, ModuleNotFoundError) and error.name and error.name.partition(".")[0] not in sys.modules:
        return f"{error}: `./zenpark install {error.name.partition('.')[0]}` adds a package of that name"
    return f"{type(error).__name__}: {error}"


def _origin_of(group: str, name: str) -> str:
    return f"plug-in {files.plain(name)!r}" if files.is_choice(name) else _origin(registered(group)[name][0])


def _origin(entry: EntryPoint) -> str:
    distribution = distribution_name(entry.dist) if entry.dist is not None else "an unnamed distribution"
    return f"plug-in {entry.name!r} ({entry.value}) of {distribution}"


# Exceptions from mistakes in a plug-in, and of one that ends the process. Ctrl-C is none of them.
FAILURES: Final = (
    AttributeError, TypeError, ValueError, NameError, LookupError, ArithmeticError, AssertionError, RuntimeError,
    StopIteration, MemoryError, SystemExit, GeneratorExit,
)  # fmt: skip
# Exceptions from the import of a foreign module.
_IMPORT_FAILURES: Final = (*FAILURES, ImportError, SyntaxError, OSError)
