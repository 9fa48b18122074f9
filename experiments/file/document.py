"""Reading of an experiment file, its cases and the changes of the command line, with all errors at once.

document = read("robotic-park", ["robots.CF01.hover=0.7"])
for name, plan in document.cases().items(): ...
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from agents.plugins import files
from agents.plugins.registry import did_you_mean
from experiments.catalogue import index
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.file import arena_file, catalogue, consistency, structure
from experiments.file.arena_file import ArenaFile
from experiments.file.overrides import Override, assign, fill_from_files, fill_from_shape, law_files, merged, parse
from experiments.file.problems import DocumentError, Fault, Problem, Text, nearest, refusal
from experiments.file.problems import Path as Keys
from experiments.file.text import content, decoded, parsed

__all__ = ["Document", "DocumentError", "Problem"]

_Table = dict[str, Any]
UNNAMED: Final = "default"  # the case of an experiment without cases
TEXT: Final = "text"  # what an experiment is called that stands in no file
_OF_THE_FILE: Final = ("cases", "criteria")  # keys that no case has
_ABOVE: Final = (("arena",), ("arena", "file"))  # changes after which the arena may begin with another file


@dataclass(frozen=True)
class Document:
    """Experiment file without errors."""

    path: Path  # the file that was read
    text: str  # as it stands there
    # what it says, before any case changes it; `--set` is in it. Its arena is complete, whatever file it begins with.
    plan: Plan
    resolved: Mapping[str, Plan]
    # the arena file of each case that has one; of the file without cases under the empty name
    arenas: dict[str, ArenaFile] = field(default_factory=dict)
    overrides: Sequence[Override] = ()  # behind `--set`
    plugins: dict[str, Path] = field(default_factory=dict)  # files of plug-ins, by their names in the experiment

    @property
    def experiment(self) -> Experiment:
        return self.plan.experiment

    @property
    def source(self) -> Source:
        """Places of its keys."""
        return Source(str(self.path), self.text, _is_json(self.path), self.overrides, self.arenas)

    def cases(self) -> dict[str, Plan]:
        """Each case, compiled, in the order of the file; one called "default" if it has none."""
        return dict(self.resolved)

    def keep(self, file: Path) -> None:
        """Writes the text to a file, and beside it the arena files and files of plug-ins and laws that it names."""
        for plan in self.resolved.values():
            law = plan.experiment.formation.law
            for parameter, model in law_files(law).items():
                if isinstance(law, dict) and law.get(parameter):
                    (file.parent / law[parameter]).write_bytes(b64decode(law[model]))
        file.write_text(self.text, encoding="utf-8")
        for each in self.arenas.values():
            (file.parent / each.name).write_text(each.text, encoding="utf-8")
        for choice, kept in self.plugins.items():
            copy = file.parent / files.plain(choice).partition(":")[0]
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(kept.read_bytes())

    @property
    def listing(self) -> str:
        """The text, and below it those of the arena files that it names: for people."""
        return join_texts([self.text, *dict.fromkeys(each.text for each in self.arenas.values())])


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


def load(file: str | Path, *overrides: str) -> Document:
    return read(file, overrides)


def loads(text: str, *overrides: str) -> Document:
    """As `read`, of an experiment in TOML that stands in no file; its arena files are those of this folder."""
    return _document(Path(TEXT), TEXT, decoded(text.encode(), TEXT), overrides)


def received(text: str, label: str) -> Document:
    """As `read`, of an experiment that came as JSON over a pipe; its arena is in it."""
    return _document(Path(label), label, text, (), is_json=True)


def _is_json(file: Path) -> bool:
    return file.suffix.lower() == ".json"


def _document(file: Path, label: str, text: str, flags: Sequence[str], *, is_json: bool | None = None) -> Document:
    is_json = _is_json(file) if is_json is None else is_json
    try:
        content = parsed(text, label, json=is_json)
        adopted = _Adopted(file.parent)
        content = adopted.table(content)
        overrides = [adopted.override(each) for each in _overrides(flags, content)]
        source = Source(label, text, is_json, overrides)
        source.refuse([*structure.number_faults(content), *adopted.faults])
        documents, tables = _resolved(file, source, content)
        nested = [
            Fault(("cases", name, key), f"a case cannot hold {key}", "they stand at the top of the file", on_key=True)
            for name, table in tables.items()
            for key in _OF_THE_FILE
            if key in table
        ]
        shapes = {
            name: [*fill_from_files(each, file.parent), *fill_from_shape(each), *structure.faults(each)]
            for name, each in documents.items()
        }
        source.refuse([*nested, *_each_once(shapes, tables)])
        plans = {name: Plan(msgspec.convert(each, Experiment)) for name, each in documents.items()}
        found = {name: list(consistency.faults(plan)) for name, plan in plans.items()}
        source.refuse(_each_once(found, tables))
        if tables or not is_json:  # a case that was written as JSON names cases that are not in it
            source.refuse(consistency.criteria_faults(plans[None], tables or [UNNAMED]))
    except RecursionError:
        raise refusal(label, "tables or lists are nested too deeply", "flatten them") from None
    cases = {name: plan for name, plan in plans.items() if name is not None} or {UNNAMED: plans[None]}
    return Document(file, text, plans[None], cases, source.arenas, source.overrides, adopted.plugins)


@dataclass(frozen=True)
class _Adopted:
    """The files of plug-ins that a document names, adopted; see `agents.plugins.files`."""

    folder: Path  # of the experiment file
    plugins: dict[str, Path] = field(default_factory=dict)  # copies, by choice
    faults: list[Fault] = field(default_factory=list)

    def table(self, content: _Table) -> _Table:
        """A document, with its cases, in which choices have the digest of their file."""
        cases = {
            name: structure.with_choices(each, (), partial(self._take, ("cases", name)))
            for name, each in _tables(content).items()
        }
        document: _Table = structure.with_choices(_without_cases(content), (), partial(self._take, ()))
        criteria = document.get("criteria")
        for number, each in enumerate(criteria if isinstance(criteria, list) else []):
            if isinstance(each, dict) and isinstance(each.get("metric"), str):
                each["metric"] = self._take((), each["metric"], ("criteria", number, "metric"))
        return {**content, **document, **({"cases": {**content["cases"], **cases}} if cases else {})}

    def override(self, given: Override) -> Override:
        """The same of a `--set`; raises DocumentError for a file that cannot be adopted."""
        of_kind = given.path[-1] == "kind"  # set alone, of a choice that is a table
        path, value = (given.path[:-1], {"kind": given.value}) if of_kind else (given.path, given.value)
        known = len(self.faults)
        changed = structure.with_choices(value, path, partial(self._take, ()))
        for fault in self.faults[known:]:
            raise given.refused(fault.message, fault.hint)
        return replace(given, value=changed["kind"] if of_kind else changed)

    def _take(self, above: Keys, name: str, path: Keys) -> str:
        if not files.is_choice(name) or files.plain(name) != name:
            return name
        try:
            choice, copy = files.adopt(name, self.folder)
        except ValueError as error:
            message, _, hint = str(error).partition("; ")
            self.faults.append(Fault((*above, *path), message, hint))
            return name
        self.plugins[choice] = copy
        return choice


def _overrides(flags: Sequence[str], content: _Table) -> list[Override]:
    overrides, problems = [], []
    for flag in flags:
        try:
            override = parse(flag, content)
        except DocumentError as error:
            problems += error.problems
            continue
        overrides.append(override)
        for fault in structure.number_faults(override.value, override.path):
            problems += override.refused(fault.message, fault.hint).problems
    if problems:
        raise DocumentError(problems)
    return overrides


@dataclass(frozen=True)
class Source(Text):
    """Text of an experiment with its changes and its arena files."""

    overrides: Sequence[Override] = ()
    arenas: dict[str, ArenaFile] = field(default_factory=dict)

    def located(self, fault: Fault) -> Problem:
        """A fault in the text, in an arena file or in a `--set`."""
        path = fault.path
        case, inside = (path[1], path[2:]) if path[:1] == ("cases",) and len(path) > 1 else ("", path)
        for override in reversed(self.overrides):
            whole = override.whole
            if path[: len(whole)] == whole or (override.case is None and inside[: len(whole)] == whole):
                return override.refused(fault.message, fault.hint).problems[0]
            if whole[: len(path)] == path and path not in self.places:
                return override.refused(fault.message, fault.hint).problems[0]
        stands, _ = nearest(self.places, path)
        file = self.arenas.get(str(case), self.arenas.get(""))
        if file is not None and len(nearest(file.places, inside)[0]) > len(stands) - (len(path) - len(inside)):
            return file.located(replace(fault, path=inside))
        return super().located(fault)


def join_texts(texts: Sequence[str]) -> str:
    """The text of an experiment file, and below it those of its arena files: for people."""
    return "\n\n# ---- the arena file ----\n\n".join(texts)


def write_json(plan: Plan) -> bytes:
    """The experiment as JSON that `read` takes; what has its default is left out."""
    return msgspec.json.format(msgspec.json.encode(plan.experiment), indent=2) + b"\n"


def _resolved(file: Path, source: Source, content: _Table) -> tuple[dict[str | None, _Table], dict[str, _Table]]:
    """The document of the file, under None, and of each case, all with `--set`; and the tables of the cases.

    The keys of an arena file are put below those of the [arena] of the experiment, where `--set` finds them. Only a
    change of which file that is must come first.
    """
    content, of_all = deepcopy(content), [each for each in source.overrides if each.case is None]
    of_all = [each for each in of_all if each.path[0] != "cases"]  # the others make a case, or replace one
    for override in source.overrides:
        if override.case is not None:
            assign(_tables(content).get(override.case, {}), override, part=True)
        elif override not in of_all:
            assign(content, override)
    tables, documents = _tables(content), dict[str | None, _Table]()
    unused: dict[Override, list[str]] = {override: [] for override in of_all if override.path not in _ABOVE}
    for name, table in ((None, {}), *tables.items()):
        document = deepcopy(merged(_without_cases(content), _without_cases(table)))
        mine = [*of_all, *(each for each in source.overrides if each.case is not None and each.case == name)]
        for override in mine:
            if override.path in _ABOVE:
                assign(document, override)
        documents[name] = document = _with_arena_file(file, source, document, name)
        for override in mine:
            if override.path not in _ABOVE:
                known = assign(document, override)
                if known is None:
                    unused.pop(override, None)
                elif override in unused:
                    unused[override] += known
    if unused:
        raise DocumentError([_unused(override, known) for override, known in unused.items()])
    if "cases" in content:
        documents[None]["cases"] = content["cases"]
    return documents, tables


def _with_arena_file(file: Path, source: Source, document: _Table, case: str | None) -> _Table:
    """Merge the arena file into the [arena] of a document, which then names no file."""
    name, files = arena_file.arena_file_name(document), source.arenas
    if name is None:
        return document
    try:
        known = (each for each in files.values() if each.name == name)
        own = files[case or ""] = next(known, None) or arena_file.load(name, file.parent)
    except arena_file.Misnamed as error:
        path = error.fault.path if case is None else ("cases", case, *error.fault.path)
        source.refuse([replace(error.fault, path=path)])
        raise
    table = {key: value for key, value in document["arena"].items() if key != "file"}
    return deepcopy({**document, "arena": merged(own.table, table, ("arena",))})


def _unused(override: Override, known: Sequence[str]) -> Problem:
    """Problem of a parameter that no trigger, law or plan of the experiment has; they have those `known`."""
    end = next(end for end in range(1, len(override.path)) if structure.group_of(override.path[:end]))
    parameter = str(override.path[end])
    message = f"no {override.path[end - 1]} of this experiment has a parameter '{parameter}'"
    return override.refused(message, did_you_mean(parameter, dict.fromkeys(known))).problems[0]


def _each_once(found: Mapping[str | None, Sequence[Fault]], tables: Mapping[str, _Table]) -> Iterator[Fault]:
    """Faults of the file, and those that a case adds to them, at the key of the case that causes them."""
    yield from found[None]
    for name, table in tables.items():
        for fault in found[name]:
            if fault in found[None]:
                continue
            own = _beginning(table, fault.path)
            message = fault.message
            if own != fault.path:
                message = f"in case '{name}', {'.'.join(map(str, fault.path))}: {message}"
            yield Fault(("cases", name, *own), message, fault.hint, fault.on_key and own == fault.path)


def _tables(document: _Table) -> dict[str, _Table]:
    """Tables of the cases; values that are no tables are left out."""
    cases = document.get("cases")
    return {name: table for name, table in cases.items() if isinstance(table, dict)} if isinstance(cases, dict) else {}


def _without_cases(table: _Table) -> _Table:
    return {key: value for key, value in table.items() if key != "cases"}


def _beginning(table: object, path: Keys) -> Keys:
    """The longest beginning of a path that leads somewhere in a table."""
    at: Any = table
    for length, step in enumerate(path):
        try:
            at = at[step]
        except (KeyError, IndexError, TypeError):
            return path[:length]
    return path


def case_document(plan: Plan, case: str = UNNAMED) -> bytes:
    """A case as one line of JSON for a robot without a file; without criteria and the hosts of the other robots.

    Its name comes with it: `Document.cases` of what is received has this case alone.
    """
    arena = msgspec.structs.replace(plan.experiment.arena, file=None)  # what stood there is in it
    cases: dict[str, dict[str, Any]] = {} if case == UNNAMED else {case: {}}
    formation, law = plan.experiment.formation, plan.experiment.formation.law
    if isinstance(law, dict):  # likewise
        law = {key: value for key, value in law.items() if key not in law_files(law)}
        formation = msgspec.structs.replace(formation, law=law)
    bare = plan.changed(arena=arena, formation=formation, hosts={}, criteria=[], cases=cases)
    return msgspec.json.encode(bare.experiment)


def chosen_case(read: Document, name: str | None) -> Plan:
    """A case of an experiment by name, the first if none is named; raises as `chosen`."""
    return next(iter(chosen(read, [] if name is None else [name]).values()))


def chosen(read: Document, names: Sequence[str] = ()) -> dict[str, Plan]:
    """The cases of an experiment, all or those named, in the order of the file.

    Raises DocumentError if it has no case of that name.
    """
    cases = read.cases()
    for name in names:
        if name not in cases:
            raise refusal(str(read.path), f"no case '{name}' in this experiment", did_you_mean(name, cases))
    return {name: case for name, case in cases.items() if not names or name in names}
