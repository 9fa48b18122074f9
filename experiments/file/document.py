"""Reading of an experiment file, its cases and the changes of the command line, with all errors at once.

document = read("robotic-park", ["robots.CF01.hover=0.7"])
for name, plan in document.cases().items(): ...
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import msgspec

from agents.errors import did_you_mean
from agents.plugins import files, registry
from agents.plugins.calls import supervised
from agents.plugins.cells import law_file
from agents.plugins.law import Law
from experiments.catalogue import index
from experiments.definition.experiment import Experiment
from experiments.definition.formation import calm_gain
from experiments.definition.plan import Plan
from experiments.file import catalogue, structure
from experiments.file.cases import Source, each_once, resolve
from experiments.file.choices import Adopted, tables
from experiments.file.completion import capture_file, fill_from_files, fill_from_shape, law_of
from experiments.file.consistency.robots import device_faults
from experiments.file.consistency.whole import consistency_faults, criteria_faults
from experiments.file.graphs.links import fill_from_graph
from experiments.file.overrides import parse_all
from experiments.file.problems import DocumentError, Fault, Problem, Text, refusal
from experiments.file.text import content, decoded, number_faults, parsed

__all__ = ["Document", "DocumentError", "Problem"]

UNNAMED: Final = "default"  # the case of an experiment without cases
TEXT: Final = "text"  # what an experiment is called that stands in no file
_OF_THE_FILE: Final = ("cases", "criteria", "metrics")  # keys that no case has


@dataclass(frozen=True)
class Document:
    """Experiment file without errors."""

    path: Path  # the file that was read
    source: Source  # its text, with the places of its keys
    # what it says, before any case changes it; `--set` is in it. Its arena is complete, whatever file it begins with.
    plan: Plan
    resolved: Mapping[str, Plan]  # plans by case
    plugins: Mapping[str, Path]  # files of plug-ins, by their names in the experiment
    beside: Mapping[str, bytes] = field(default_factory=dict)  # content of the files that it names

    @property
    def experiment(self) -> Experiment:
        return self.plan.experiment

    @property
    def text(self) -> str:
        """The text as it stands in the file."""
        return self.source.text

    def cases(self) -> dict[str, Plan]:
        """Each case, compiled, in the order of the file; one called "default" if it has none."""
        return dict(self.resolved)

    def keep(self, file: Path) -> None:
        """Writes the text to a file, and beside it all files that it names."""
        for name, found in self.beside.items():
            (file.parent / name).write_bytes(found)
        file.write_text(self.text, encoding="utf-8")
        for each in self.source.arenas.values():
            (file.parent / each.name).write_text(each.text, encoding="utf-8")
        for choice, kept in self.plugins.items():
            copy = file.parent / files.plain(choice).partition(":")[0]
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(kept.read_bytes())

    @property
    def listing(self) -> str:
        """The text, and below it those of the arena files that it names: for people."""
        return join_texts([self.text, *dict.fromkeys(each.text for each in self.source.arenas.values())])


def read(path: str | Path, overrides: Sequence[str] = ()) -> Document:
    """Reads and checks an experiment.

    Args:
        path: A .toml file, a .json file as `write_json` makes it, or a name of the catalogue.
        overrides: `path=value` each, as behind `--set`; a later one wins, and all win over the cases, except those of
            one case (`cases.event.trigger.threshold=0.02`).

    Raises:
        DocumentError: With all problems and their places, for any content of the file.
    """
    file = index.find_file(path)
    label = str(path) if file == Path(path) else str(file)
    try:
        text = content(file, label)
    except FileNotFoundError:
        raise catalogue.no_entry(label) from None
    return _document(file, label, text, overrides)


def load(file: str | Path, *overrides: str, law: Law | type[Law] | None = None) -> Document:
    """As `read`, with another law if one is given: a class or an object, also of a notebook's cell or of a script."""
    if law is None:
        return read(file, overrides)
    plugin = law if isinstance(law, type) else type(law)
    with TemporaryDirectory() as folder:
        try:
            kind, copy = files.adopt(law_file(plugin, folder), Path(folder))
        except registry.PluginError as error:
            raise refusal(f"law={plugin.__name__}", *str(error).split("; ", 1)) from None
    given = {"kind": kind}
    if not isinstance(law, type):
        given |= {name: each for name, each in msgspec.to_builtins(law).items() if each is not None}
    found = read(file, (*overrides, f"formation.law={inline(given)}"))
    return replace(found, plugins={**found.plugins, kind: copy})


def inline(value: Any) -> str:  # noqa: ANN401 - a parameter of a plug-in
    """A value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {inline(each)}" for key, each in value.items()) + "}"
    return f"[{', '.join(map(inline, value))}]" if isinstance(value, list) else json.dumps(value)


def loads(text: str, *overrides: str) -> Document:
    """As `read`, of an experiment in TOML that stands in no file; its arena files are those of this folder."""
    return _document(Path(TEXT), TEXT, decoded(text.encode(), TEXT), overrides)


def received(text: str, label: str) -> Document:
    """As `read`, of an experiment that came as JSON over a pipe; its arena is in it."""
    return _document(Path(label), label, text, (), received=True)


@supervised()
def _document(file: Path, label: str, text: str, flags: Sequence[str], *, received: bool = False) -> Document:
    is_json = received or file.suffix.lower() == ".json"
    try:
        content = parsed(text, label, json=is_json)
        numbers, adopted = list(number_faults(content)), Adopted(file.parent)
        content, unread = adopted.adopt(content)
        Text(label, text, is_json).refuse([*numbers, *unread])
        source = Source(label, text, is_json, parse_all(flags, content, adopted))
        documents, tables = resolve(source, content, file.parent)
        nested = [
            Fault(("cases", name, key), f"a case cannot hold {key}", "they stand at the top of the file", on_key=True)
            for name, table in tables.items()
            for key in _OF_THE_FILE
            if key in table
        ]
        shapes, beside = dict[str | None, list[Fault]](), dict[str, bytes]()
        for name, each in documents.items():
            # files of what was received are those of another machine: their content came with it
            for fill in () if received else (fill_from_files, fill_from_graph):
                missing, contents = fill(each, file.parent)
                shapes.setdefault(name, []).extend(missing)
                beside |= contents
            shapes.setdefault(name, []).extend([*fill_from_shape(each), *structure.faults(each)])
        source.refuse([*nested, *each_once(shapes, tables)])
        plans = {name: Plan(msgspec.convert(each, Experiment)) for name, each in documents.items()}
        whole = tables or not is_json  # a case that was written as JSON names cases that are not in it
        criteria = list(criteria_faults(plans[None].experiment, tables or [UNNAMED])) if whole else []
        found = {name: list(consistency_faults(plan)) for name, plan in plans.items()}
        if not received:  # its devices were looked at already; a robot needs none of the others' bodies
            for name, plan in plans.items():
                found[name] += device_faults(plan.experiment)
                wrong, contents = capture_file(plan.experiment, file.parent, missing=not is_json)
                found[name] += wrong
                beside |= contents
        source.refuse([*criteria, *each_once(found, tables)])
    except RecursionError:
        raise refusal(label, "tables or lists are nested too deeply", "flatten them") from None
    plans = {name: _calmed(plan, documents[name]) for name, plan in plans.items()}
    cases = {name: plan for name, plan in plans.items() if name is not None} or {UNNAMED: plans[None]}
    return Document(file, source, plans[None], cases, adopted.plugins, beside)


def _calmed(plan: Plan, document: Mapping[str, Any]) -> Plan:
    """The plan with a calm gain, if the document gives none and its law pulls by it."""
    formation = plan.experiment.formation
    law = law_of(formation.law)
    if "gain" in document.get("formation", {}) or law is None or law.PULLS_BY == "stiffness":
        return plan
    gain = calm_gain(plan.experiment)
    return plan if gain == formation.gain else plan.changed(formation=msgspec.structs.replace(formation, gain=gain))


def join_texts(texts: Sequence[str]) -> str:
    """The text of an experiment file, and below it those of its arena files: for people."""
    return "\n\n# ---- the arena file ----\n\n".join(texts)


def write_json(plan: Plan) -> bytes:
    """The experiment as JSON that `read` takes; what equals its default is left out, parameters of plug-ins aside."""
    return msgspec.json.format(msgspec.json.encode(tables(plan.experiment)), indent=2) + b"\n"


def case_document(plan: Plan, case: str = UNNAMED) -> bytes:
    """A case as one line of JSON for a robot without a file; without criteria and the hosts of the other robots.

    Its name comes with it: `Document.cases` of what is received has this case alone.
    """
    arena = msgspec.structs.replace(plan.experiment.arena, file=None)  # what stood there is in it
    cases: dict[str, dict[str, Any]] = {} if case == UNNAMED else {case: {}}
    bare = plan.changed(arena=arena, hosts={}, criteria=[], metrics=[], cases=cases)
    return msgspec.json.encode(bare.experiment)


def chosen_case(read: Document, name: str | None) -> Plan:
    """A case of an experiment by name, the first if none is named; raises as `chosen`."""
    return next(iter(chosen(read, [] if name is None else [name]).values()))


def chosen(read: Document, names: Sequence[str] = ()) -> dict[str, Plan]:
    """The cases of an experiment, all or those named, in the order of the file.

    Raises DocumentError if it has no case of that name.
    """
    cases = read.cases()
    names = [names] if isinstance(names, str) else names  # a text is a sequence of letters
    for name in names:
        if name not in cases:
            raise refusal(str(read.path), f"no case '{name}' in this experiment", did_you_mean(name, cases))
    return {name: case for name, case in cases.items() if not names or name in names}
