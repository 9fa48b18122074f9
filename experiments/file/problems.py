"""Places in a TOML or JSON file, from a path in the parsed document to line and column; problems and faults.

No maintained TOML reader tells positions. The scanner here runs over text that `tomllib` has accepted, and only when
there is something to report, so it needs no checks of its own.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, time
from functools import cached_property
from typing import Any, Final

import msgspec

from agents.errors import ExplainedError, did_you_mean
from agents.plugins.files import plain

Path = tuple[str | int, ...]

# patterns that match everywhere, if need be the empty text
_BLANK: Final = re.compile(r"(?:\s+|#[^\n]*)*")  # white space, line ends and comments
_STRING: Final = r'"""(?:[^\\]|\\.)*?"{3,5}|' + r"'''.*?'{3,5}|" + r'"(?:[^"\\\n]|\\.)*"|' + r"'[^'\n]*'"
_KEY_PART: Final = re.compile(rf"[ \t]*({_STRING}|[^\s.=:\[\]{{}}\"'#,]*)[ \t]*(\.?)", re.DOTALL)
_VALUE: Final = re.compile(rf"{_STRING}|[^,\]}}#\n]*", re.DOTALL)


@dataclass(frozen=True)
class TextPosition:
    """Begin of a key and of its value, as offsets into the text."""

    key: int
    value: int


def places(text: str, *, json: bool = False) -> dict[Path, TextPosition]:
    """Place of every path of a valid document, tables and list items included."""
    scan = _Scan(text, json)
    if json:
        scan.value((), _blank(text, 0))
    else:
        scan.document()
    return scan.found


def nodes(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:  # noqa: ANN401 - a document
    """A document, or the part of it at `path`, and all that is in it, each with its path."""
    yield path, value
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else ()
    for key, each in inside:
        yield from nodes(each, (*path, key))


def nearest(found: Mapping[Path, TextPosition], path: Path) -> tuple[Path, TextPosition]:
    """The longest beginning of `path` that stands in the text."""
    for length in range(len(path), 0, -1):
        if path[:length] in found:
            return path[:length], found[path[:length]]
    return (), TextPosition(0, 0)


def line_column(text: str, offset: int) -> tuple[int, int]:
    """1-based line and column, in characters."""
    return text.count("\n", 0, offset) + 1, offset - text.rfind("\n", 0, offset)


@dataclass
class _Scan:
    text: str
    json: bool
    found: dict[Path, TextPosition] = field(default_factory=dict)
    items: dict[Path, int] = field(default_factory=dict)  # how many [[headers]] each list of tables has so far

    def document(self) -> None:
        """Headers and `key = value` lines, to the end."""
        table: Path = ()
        at = _blank(self.text, 0)
        while at < len(self.text):
            if self.text[at] == "[":
                table, at = self.header(at)
            else:
                at = self.pair(table, at)
            at = _blank(self.text, at)

    def header(self, start: int) -> tuple[Path, int]:
        """`[a.b]` or `[[a.b]]`: the table that follows, and where the header ends."""
        opening = 2 if self.text.startswith("[[", start) else 1
        parts, at = self.key(start + opening)
        table: Path = ()
        for number, (name, offset) in enumerate(parts):
            table = (*table, name)
            self.found.setdefault(table, TextPosition(offset, start))
            if opening == 2 and number == len(parts) - 1:
                self.items[table] = self.items.get(table, 0) + 1
            if table in self.items:
                table = (*table, self.items[table] - 1)
                self.found.setdefault(table, TextPosition(start, start))
        return table, at + opening

    def pair(self, table: Path, start: int) -> int:
        """`a.b = value` (or `"a": value`) in `table`; where it ends."""
        parts, at = self.key(start)
        at = _blank(self.text, at + 1)
        path = table
        for name, offset in parts:
            path = (*path, name)
            self.found.setdefault(path, TextPosition(offset, at))
        return self.value(path, at)

    def key(self, at: int) -> tuple[list[tuple[str, int]], int]:
        """The parts of a dotted key with their offsets, and where the delimiter behind it stands."""
        parts, dot = [], "."
        while dot:
            match = _match(_KEY_PART, self.text, at)
            name, dot = match[1], match[2]
            at = match.end()
            if name[:1] in ('"', "'"):  # text inside its quotes and escapes
                name = str(msgspec.json.decode(name) if self.json else tomllib.loads(f"key = {name}")["key"])
            parts.append((name, match.start(1)))
        return parts, at

    def value(self, path: Path, at: int) -> int:
        """Scan the value behind `=`; return its end."""
        closing = {"[": "]", "{": "}"}.get(self.text[at : at + 1])
        if closing is not None:
            return self.several(path, at, closing)
        return _match(_VALUE, self.text, at).end()

    def several(self, path: Path, at: int, closing: str) -> int:
        """Scan a list or an inline table; return its end."""
        number = 0
        at = _blank(self.text, at + 1)
        while at < len(self.text) and self.text[at] != closing:
            if closing == "]":
                item = (*path, number)
                self.found.setdefault(item, TextPosition(at, at))
                at, number = self.value(item, at), number + 1
            else:
                at = self.pair(path, at)
            at = _blank(self.text, at)
            if self.text[at : at + 1] == ",":
                at = _blank(self.text, at + 1)
        return at + 1


def _match(pattern: re.Pattern[str], text: str, at: int) -> re.Match[str]:
    match = pattern.match(text, at)
    assert match is not None
    return match


def _blank(text: str, at: int) -> int:
    """Offset behind white space, line ends and comments."""
    return _match(_BLANK, text, at).end()


SHOWN_CHARACTERS = 100  # characters of a source line; longer ones are cut around the place
MAX_PROBLEMS = 20  # problems in one message


@dataclass(frozen=True)
class Fault:
    """Error at a path of the document, not yet located in the text."""

    path: Path  # keys and list indices from the top of the document
    message: str  # what is wrong
    hint: str = ""  # what to do
    on_key: bool = False  # the key itself is wrong, not its value


def unknown_robot(path: Path, name: str, robots: Iterable[str], *, on_key: bool = False) -> Iterator[Fault]:
    if name not in (known := list(robots)):
        yield Fault(path, f"no robot is called '{name}'", did_you_mean(name, known), on_key)


def after_the_end(path: Path, what: str, from_s: float, duration_s: float) -> Iterator[Fault]:
    """The fault of what begins when the run is over, if it does."""
    if from_s >= duration_s:
        message = f"this {what} begins at {from_s:g} s, when the run of {duration_s:g} s is over"
        yield Fault(path, message, "begin earlier, or give a longer duration_s")


@dataclass(frozen=True)
class Problem:
    """Error at a place. Line and column are 1-based, 0 without a text to point into."""

    file: str  # name that the user gave; or the command-line flag that is at fault
    line: int  # line number
    column: int  # number of characters
    message: str  # what is wrong
    hint: str = ""  # what to do
    source: str = ""  # the line of text

    @property
    def place(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file

    def __str__(self) -> str:
        parts = [f"{_printable(self.place)}: {_printable(self.message)}"]
        if self.line:
            shown, caret = _window(self.source, self.column - 1)
            parts += [f"{self.line:>6} | {shown}", f"       | {caret}^"]
        if self.hint:
            parts.append(f"       = {_printable(self.hint)}" if self.line else f"  {_printable(self.hint)}")
        return "\n".join(parts)


class DocumentError(ExplainedError, ValueError):
    """Experiment that cannot be read, with all of its problems."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        more = [f"and {len(problems) - MAX_PROBLEMS} more"] if len(problems) > MAX_PROBLEMS else []
        super().__init__("\n".join([*map(str, problems[:MAX_PROBLEMS]), *more]))
        self.problems = list(problems)


def refusal(file: str, message: str, hint: str = "") -> DocumentError:
    """The error of one problem without a place in the text."""
    return DocumentError([Problem(plain(file), 0, 0, plain(message), plain(hint))])


def at_offset(file: str, text: str, offset: int, message: str, hint: str = "") -> Problem:
    line, column = line_column(text, offset)
    return Problem(file, line, column, plain(message), plain(hint), text.split("\n")[line - 1])


@dataclass(frozen=True)
class Text:
    """Text of a file: where each fault has its place."""

    label: str  # the file, as the user named it
    text: str  # text that stands there
    is_json: bool

    @cached_property
    def places(self) -> dict[Path, TextPosition]:
        return places(self.text, json=self.is_json)

    def refuse(self, faults: Iterable[Fault]) -> None:
        """Raise DocumentError if there is any fault, all in the order of the file."""
        problems = dict.fromkeys(map(self.located, faults))
        if problems:
            files = (self.label, *(problem.file for problem in problems if not problem.line))
            raise DocumentError(sorted(problems, key=lambda each: (each.file not in files, each.line, each.column)))

    def located(self, fault: Fault) -> Problem:
        stands, place = nearest(self.places, fault.path)
        offset = place.key if fault.on_key and stands == fault.path else place.value
        return at_offset(self.label, self.text, offset, fault.message, fault.hint)


def key_name(path: Path) -> str:
    """Name of a path for people: the last key, with its indices."""
    first = max((number for number, step in enumerate(path) if isinstance(step, str)), default=0)
    return "".join(f"[{step}]" if isinstance(step, int) else str(step) for step in path[first:])


def shown(value: object) -> str:
    """A value of the document, short enough for one line."""
    if isinstance(value, date | time):  # types of TOML
        return value.isoformat()
    words = {True: "true", False: "false", None: "null"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _window(source: str, column: int) -> tuple[str, str]:
    """The part of a line around a column, and the blanks that lead to that column (tabs stay, so that they line up)."""
    first = max(0, column - SHOWN_CHARACTERS // 2) if len(source) > SHOWN_CHARACTERS else 0
    part = source[first : first + SHOWN_CHARACTERS]
    blanks = "".join("\t" if letter == "\t" else " " for letter in part[: column - first])
    cut = "..." if first else ""
    return cut + _printable(part), " " * len(cut) + blanks


def _printable(text: str) -> str:
    """Control characters and lone surrogates replaced: they would upset the terminal."""
    return "".join(letter if letter.isprintable() or letter == "\t" else "\ufffd" for letter in text)
