"""Gaps of a document, filled: targets of links from a drawn shape, and the content of files that a law names."""

from __future__ import annotations

import math
import pathlib
from base64 import b64encode
from collections.abc import Mapping
from typing import Any, Final, cast

import msgspec

from agents.errors import did_you_mean
from agents.plugins import registry
from agents.plugins.law import Law
from experiments.catalogue import index
from experiments.definition.experiment import TARGETS, Experiment, Formation
from experiments.definition.links import TARGET_KINDS, link_pairs, pairs_or_none
from experiments.file.choices import group_of, struct_of
from experiments.file.overrides import SHAPE
from experiments.file.problems import Fault, Path, nodes

ALONE: Final = "link"  # a link without a target
LARGEST_FILE: Final = 1_000_000  # [bytes] largest file that an experiment names
LOOKED_AT: Final = 100  # number of files beside an experiment, for the one that was meant
_OWNERS: Final = ("trigger", "formation", "timeline", "arena")  # tables with a choice of a plug-in
# files that stand beside the experiment in the folder of a run or of a sweep
TAKEN_NAMES: Final = (
    "experiment.toml",
    "metrics.csv",
    "errors.csv",
    "sweep.csv",
    "tried.csv",
    "metrics.json",
    "run.json",
)


def fill_from_shape(document: dict[str, Any]) -> list[Fault]:
    """Gives the links without a target of their own, in place, the one that the places of [formation.shape] have.

    What is malformed otherwise is left for the checks that follow.
    """
    formation = document.get("formation")
    links = formation.get("links") if isinstance(formation, dict) else None
    if not isinstance(formation, dict) or not isinstance(links, dict):
        return []
    shape, robots = formation.get("shape"), document.get("robots")
    faults = list[Fault]()
    bare = [
        text
        for text, given in links.items()
        if given == SHAPE or (shape is not None and isinstance(given, dict) and not {*TARGETS} & given.keys())
    ]
    links.update({text: {} for text, given in links.items() if given == ALONE})
    law = law_of(formation.get("law", Formation().law))
    word = TARGET_KINDS["any" if law is None else law.NEEDS].fields[0]
    for text in bare:
        target = _target_in(shape, robots, text, word, ("formation", "links", text))
        if isinstance(target, Fault):
            faults.append(target)
            target = 1.0 if word == "distance" else [1.0, 0.0]
        given = links[text]
        links[text] = {**given, word: target} if isinstance(given, dict) else {word: target}
    changes = formation.get("changes")
    for number, change in enumerate(changes if isinstance(changes, list) else []):
        if isinstance(change, dict) and isinstance(change.get("shape"), dict):
            own, path = change.setdefault("links", {}), ("formation", "changes", number, "shape")
            for text in (text for text in bare if isinstance(own, dict) and text not in own):
                target = _target_in(change["shape"], robots, text, word, path)
                if isinstance(target, Fault):
                    faults.append(target)
                else:
                    own[text] = {word: target}
    return faults


def fill_from_files(document: dict[str, Any], folder: pathlib.Path) -> tuple[list[Fault], dict[str, bytes]]:
    """Gives choices, in place, the content of the files that they name, which are in `folder` or the catalogue.

    Without such a file a choice keeps the content that it has: the experiment comes from where the file was.

    Returns:
        What is wrong, and the content of each file by its name.
    """
    faults, contents = list[Fault](), dict[str, bytes]()
    for path, choice in [*nodes({key: document[key] for key in _OWNERS if key in document})]:
        group = group_of(path)
        if group is None or not isinstance(choice, dict):
            continue
        for parameter, content in named_files(choice, group).items():
            name = choice.get(parameter)
            if not isinstance(name, str) or not name:
                continue
            found = content_of(name, folder, (*path, parameter), missing=content not in choice)
            if isinstance(found, Fault):
                faults.append(found)
            elif found is not None:
                contents[name] = found
                choice[content] = b64encode(found).decode()
    return faults, contents


def capture_file(
    experiment: Experiment, folder: pathlib.Path, *, missing: bool
) -> tuple[list[Fault], dict[str, bytes]]:
    """Faults of the file of a system that measures positions, and its content by its name.

    Args:
        missing: Whether a file that is not there is a fault; processes of a run get its place.
    """
    capture = experiment.capture
    if capture is None or capture.system not in registry.names(registry.POSITIONING):
        return [], {}
    reader = registry.load(registry.POSITIONING, capture.system)
    if not reader.FILE or not capture.address:
        return [], {}
    path: Path = ("positioning",) if isinstance(experiment.positioning, str) else ("positioning", "source")
    content = content_of(capture.address, folder, path, missing=missing)
    if not isinstance(content, bytes):
        return [content] if content else [], {}
    measured = {name: robot for name, robot in experiment.robots.items() if robot.position == "external"}
    flies = {capture.names.get(name, name): robot.hover is not None for name, robot in measured.items()}
    try:
        reader.check(content.decode(errors="replace"), capture.address, flies, simulated=capture.simulated)
    except ValueError as error:
        message, _, remedy = str(error).partition("; ")
        return [Fault(path, message, remedy)], {}
    return [], {capture.address: content}


def content_of(name: str, folder: pathlib.Path, path: Path, *, missing: bool = True) -> bytes | Fault | None:
    """Content of a file that an experiment names; the fault at `path`.

    Args:
        missing: Whether a file that is not there is a fault; else None is returned for it.
    """
    file = index.file_beside(name, folder)
    if file is None:
        hint = "put it beside the experiment file, and give its name alone"
        return Fault(path, f"{name!r} is no name of a file", hint)
    if name.lower() in TAKEN_NAMES:
        return Fault(path, f"{name!r} is the name of another file in the folder of a run", "call it otherwise")
    try:
        with file.open("rb") as stream:
            found = stream.read(LARGEST_FILE + 1)
    except OSError as error:
        if not missing:
            return None
        message = f"{file} cannot be read: {error.strerror or error}"
        known = [each.name for each in sorted(folder.glob(f"*{file.suffix}"))[:LOOKED_AT]]
        hint = did_you_mean(name, known) if known and file.suffix else ""
        return Fault(path, message, hint or "put it beside the experiment file")
    if len(found) > LARGEST_FILE:
        message = f"{name} is longer than {LARGEST_FILE // 1_000_000} MB"
        return Fault(path, message, "take a smaller one: it goes with the experiment to every robot")
    return found


def named_files(choice: object, group: str) -> Mapping[str, str]:
    """Parameters of a chosen plug-in that name files, and those that get their content; none if it cannot be used."""
    struct = _struct(choice, group)
    files: Mapping[str, str] = getattr(struct, "FILES", {})
    return files


def law_of(choice: object) -> type[Law] | None:
    """The law of a choice; None if it cannot be used, which is said with its place where the law is read."""
    return cast("type[Law] | None", _struct(choice, registry.LAWS))


def _struct(choice: object, group: str) -> type[msgspec.Struct] | None:
    name = choice.get("kind") if isinstance(choice, Mapping) else choice
    try:
        return struct_of(group, name) if isinstance(name, str) else None
    except registry.PluginError:
        return None


def _target_in(shape: object, robots: object, text: str, word: str, path: Path) -> float | list[float] | Fault:
    """Distance [m], offset [m] or bearing of a link between places; the fault at `path` if they give none."""
    if not pairs_or_none(text):
        return 1.0 if word == "distance" else [1.0, 0.0]
    second, first = link_pairs(text)[0]
    if first == second:
        return Fault(path, f"'{first}' cannot receive from itself", "name two robots")
    places, planar = [], True
    for name in (first, second):
        place = shape.get(name) if isinstance(shape, Mapping) else None
        if not (isinstance(place, list) and 2 <= len(place) <= 3 and all(type(x) in (int, float) for x in place)):
            if isinstance(robots, Mapping) and name not in robots:
                return Fault(path, f"no robot is called '{name}'", did_you_mean(name, robots))
            hint = f"add {name} = [0.5, 0.0] to [formation.shape], or give the link a distance"
            return Fault(path, f"{name} has no place in the shape", hint)
        robot = robots.get(name) if isinstance(robots, Mapping) else None
        height = robot.get("hover") if isinstance(robot, Mapping) else None
        planar = planar and len(place) == 2
        places.append([*place, height if type(height) in (int, float) else 0.0][:3])
    offset = [b - a for a, b in zip(*places, strict=True)]
    length = math.hypot(*offset)
    if length == 0.0:
        return Fault(path, f"{first} and {second} are at one place of the shape", "move one of them")
    kept = offset[:2] if planar else offset
    return length if word == "distance" else kept
