"""Choices of plug-ins in a document: where they stand, their structs, and the Python files that hold some of them."""

from __future__ import annotations

import importlib
import pathlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from inspect import getfile
from typing import Any, Final

import msgspec

from agents.body.kinds import KINDS
from agents.fields import default_of, fields_of
from agents.plugins import files, registry
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.file.problems import Fault, Path, nodes

# entry-point group of each choice of a plug-in; `int` is any number in a list, `str` any name
_GROUPS: Final[Mapping[tuple[str | int | type, ...], str]] = {
    ("trigger",): registry.TRIGGERS,
    ("formation", "update"): registry.TRIGGERS,
    ("prediction",): registry.PREDICTORS,
    ("formation", "law"): registry.LAWS,
    ("timeline", int, "plan"): registry.PLANNERS,
    ("arena", "obstacles", str, "plan"): registry.PLANNERS,
    ("avoidance",): registry.AVOIDANCES,
    ("world", "engine"): registry.ENGINES,
}
PLACES: Final = {  # a key for each group
    group: ".".join(part for part in path if isinstance(part, str)) for path, group in reversed([*_GROUPS.items()])
}
_METRICS: Final = (("criteria", int, "metric"), ("metrics", int))  # may be classes in files, too
_NAMING: Final = (*_GROUPS, *_METRICS)


def group_of(path: Path) -> str | None:
    """Entry-point group of the plug-in choice at a path; None if no choice stands there."""
    return _GROUPS.get(_pattern(path))


def _pattern(path: Path) -> tuple[str | int | type, ...]:
    return path if len(path) < 3 else (*path[:-2], type(path[-2]), path[-1])


@dataclass(frozen=True)
class Adopted:
    """Copies of the Python files that a document names, see `agents.plugins.files`."""

    folder: pathlib.Path  # folder of the experiment file
    plugins: dict[str, pathlib.Path] = field(default_factory=dict)  # copies, by choice

    def adopt(self, value: Any, path: Path = ()) -> tuple[Any, list[Fault]]:  # noqa: ANN401 - a document
        """A document, or the part of it at `path`, with the digest of the file in each choice; and what is wrong."""
        faults = list[Fault]()

        def take(name: str, at: Path) -> str:
            if not files.is_choice(name) or files.plain(name) != name:
                return name
            try:
                choice, copy = files.adopt(name, self.folder)
            except ValueError as error:
                message, _, hint = str(error).partition("; ")
                faults.append(Fault(at, message, hint))
                return name
            self.plugins[choice] = copy
            return choice

        return _with_names(value, path, take), faults


def _with_names(value: Any, path: Path, change: Callable[[str, Path], str]) -> Any:  # noqa: ANN401 - a document
    """A part of a document, which stands at `path`, with the name of every chosen plug-in changed, in cases too."""
    inside = path[2:] if path[:1] == ("cases",) else path
    choice = inside[:-1] if inside[-1:] == ("kind",) else inside
    if isinstance(value, str):
        of_metric = any(len(inside) == len(to) and _leads(inside, to) for to in _METRICS)
        return change(value, path) if of_metric or group_of(choice) else value
    if isinstance(value, dict | list) and not any(_leads(inside, to) for to in _NAMING):
        return value  # thousands of robots and links are passed over
    if isinstance(value, dict):
        return {key: _with_names(each, (*path, key), change) for key, each in value.items()}
    if isinstance(value, list):
        return [_with_names(each, (*path, number), change) for number, each in enumerate(value)]
    return value


def _leads(path: Path, to: tuple[str | int | type, ...]) -> bool:
    steps = zip(path, to, strict=False)
    return len(path) <= len(to) and all(step == part or type(step) is part for step, part in steps)


def struct_of(group: str, kind: str) -> type[msgspec.Struct]:
    """The struct of parameters of a plug-in; raises PluginError if it cannot be used."""
    return registry.struct(group, kind)


def usable_metric(name: str) -> Any:  # noqa: ANN401 - a Metric: their module imports those of files
    """The metric of a name; raises PluginError if it cannot be used."""
    return registry.find("experiments.metrics.metric:usable_metric", "metrics")(name)


def parameters(group: str, kind: str) -> list[str]:
    """Names of the parameters of a plug-in, none if it cannot be used."""
    try:
        return list(struct_of(group, kind).__struct_encode_fields__)
    except registry.PluginError:
        return []


def tables(value: Any, path: Path = (), *, uniform: bool = False) -> Any:  # noqa: ANN401 - a part of an experiment
    """An experiment, or the part of it at `path`, as plain tables and lists; what equals its default is left out.

    Args:
        uniform: Whether choices of plug-ins that mean the same are written the same, as for a digest.
    """
    if uniform and isinstance(value, str | dict) and (group := group_of(path)) is not None:
        kind, given = registry.split(value)
        defaults = {name: default_of(field) for name, field in fields_of(struct_of(group, kind)).items()}
        return [kind, {key: _numbers(each) for key, each in given.items() if each != defaults[key]}]
    if isinstance(value, msgspec.Struct):
        found = {}
        for name, field_ in fields_of(type(value)).items():
            inside = (*path, name)
            each = tables(getattr(value, field_.name), inside, uniform=uniform)
            if field_.required or each != tables(default_of(field_), inside, uniform=uniform):
                found[name] = each
        return found
    if isinstance(value, dict):
        return {key: tables(each, (*path, key), uniform=uniform) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [tables(each, (*path, number), uniform=uniform) for number, each in enumerate(value)]
    return value


def _numbers(value: Any) -> Any:  # noqa: ANN401 - a parameter of a plug-in
    """A parameter with floats for all whole numbers, as which a parameter is read."""
    if isinstance(value, list):
        return [_numbers(each) for each in value]
    return float(value) if type(value) is int else value


def chosen(experiment: Experiment) -> list[tuple[str, str]]:
    """Group and name of every plug-in that an experiment chooses, kinds of robots and defaults aside."""
    found = ((group_of(path), choice) for path, choice in nodes(tables(experiment)))
    return [(group, registry.split(choice)[0]) for group, choice in found if group is not None]


def plugin_files(plan: Plan) -> set[pathlib.Path]:
    """Modules of the plug-ins and kinds that an experiment chooses; what those import is not among them."""
    experiment = plan.experiment
    kinds = {KINDS[robot.kind] for robot in (*experiment.robots.values(), *experiment.spares.values())}
    modules = {registry.module(registry.ROBOTS, kind.name) for kind in kinds}
    modules |= {kind.motion.partition(":")[0] for kind in kinds if isinstance(kind.motion, str)}
    modules |= {type(kind.steering).__module__ for kind in kinds if kind.steering is not None}
    modules_of_kinds = {pathlib.Path(getfile(importlib.import_module(name))) for name in modules}
    return modules_of_kinds | {pathlib.Path(getfile(struct_of(group, kind))) for group, kind in chosen(experiment)}
