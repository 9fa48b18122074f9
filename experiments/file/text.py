"""From bytes to a document; an error of text, TOML or JSON has its place and a remedy."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from experiments.file.problems import DocumentError, Fault, Problem, at_offset, key_name, nodes, refusal
from experiments.file.problems import Path as Keys

MAX_NUMBER: Final = 1e12  # largest number in any unit; squares and products of larger numbers are not finite for long
MAX_TEXT_BYTES: Final = 4_000_000  # bytes; a hundred robots take ten thousand
BEGIN: Final = "./zenpark new copies an experiment to begin with"
# key of many parts, for 20,000 of which `tomllib` takes seconds and gigabytes; numbers in lists are none
_ENDLESS: Final = re.compile(r"""(?<![\w"'.-])(?:["']?[\w-]++["']?[ \t]*+\.[ \t]*+){50}""")
_INLINE: Final = "an inline table stands on one line and ends without a comma; or write [table] and its keys below"
_AT: Final = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_REMEDIES: Final = (
    ("Invalid value", 'text stands in quotes, as in kind = "crazyflie"; numbers have a point, not a comma'),
    ("Expected '='", "a line is key = value, or a [table]; a key with blanks or signs stands in quotes"),
    ("Unclosed array", "a list that begins above lacks its ]"),
    ("Unclosed inline table", "an inline table lacks its }, or a comma between two of its keys"),
    ("Unterminated string", "a text lacks its closing quotes"),
    ("Illegal character", "a text lacks its closing quotes, or holds a character that cannot be typed"),
    ("Expected newline", "one key = value in a line; text stands in quotes, a comment begins with #"),
    ("Expected ']", "a header is [table], or [[timeline]] with two brackets; names are letters, digits and _"),
    ("Invalid initial character", "a key is letters, digits, _ and -, or stands in quotes"),
    ("Invalid statement", "an experiment file is TOML: a line is key = value, [table] or # comment"),
    ("Unescaped '\\'", "write a backslash twice, or use single quotes"),
)


def content(file: Path, label: str) -> str:
    """The text of a file, with plain line ends.

    Raises:
        FileNotFoundError: If there is none.
        DocumentError: If it is a folder, cannot be read, is too long, or is no text.
    """
    try:
        with file.open("rb") as stream:
            found = stream.read(MAX_TEXT_BYTES + 1)
    except FileNotFoundError:
        raise
    except IsADirectoryError:
        toml = sorted(each.name for each in file.glob("*.toml"))[:5]
        hint = f"name a file in it: {', '.join(toml)}" if toml else "name an experiment file"
        raise refusal(label, "is a folder", hint) from None
    except (OSError, ValueError) as error:
        raise refusal(label, f"cannot be read: {reason(error)}", "check the name and the permissions") from error
    if len(found) > MAX_TEXT_BYTES:
        message = f"is longer than {MAX_TEXT_BYTES // 1_000_000} MB"
        raise refusal(label, message, "name the experiment file, not a recording")
    return decoded(found, label)


def reason(error: OSError | ValueError) -> str:
    """The system's own words for an error."""
    return str(error.strerror) if isinstance(error, OSError) and error.strerror else str(error)


def decoded(content: bytes, label: str) -> str:
    """Text, with plain line ends; raises DocumentError if it is binary, empty or not UTF-8."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise refusal(label, "is text in UTF-16, as PowerShell's > writes it", "save it as UTF-8")
    if b"\0" in content:
        raise refusal(label, "is binary, no text", "name an experiment file (.toml or .json)")
    try:
        text = content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        readable = content.decode("utf-8", errors="replace").replace("\r\n", "\n")
        message = f"byte 0x{error.object[error.start]:02x} is not UTF-8"
        found = at_offset(label, readable, readable.index("\ufffd"), message, "save the file as UTF-8")
        raise DocumentError([found]) from None
    if text.lstrip().startswith("<"):
        raise refusal(
            label, "is a page, no experiment", "name an experiment file, such as experiment.toml in a run's folder"
        )
    if not text.strip():
        raise refusal(label, "is empty", BEGIN)
    return text


def parsed(text: str, label: str, *, json: bool) -> dict[str, Any]:
    """The document that a text holds.

    Raises:
        DocumentError: If it is not well-formed.
        RecursionError: If it is nested too deeply.
    """
    if json:
        return _json(text, label)
    if _ENDLESS.search(text):
        raise refusal(label, "a key has more than 50 parts", "no value of an experiment lies so deep; shorten it")
    try:
        document = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise DocumentError([_toml_problem(text, label, str(error))]) from None
    if not document:
        raise refusal(label, "holds nothing but comments", BEGIN)
    return document


def number_faults(document: object, path: Keys = ()) -> Iterator[Fault]:
    """Faults of numbers that TOML can write and no experiment can hold."""
    for at, value in nodes(document, path):
        if isinstance(value, float) and not math.isfinite(value):
            yield Fault(at, f"'{key_name(at)}' is {value}, which is no quantity", "give a finite number")
        elif isinstance(value, float) and abs(value) > MAX_NUMBER:
            yield Fault(at, f"'{key_name(at)}' is {value:g}, larger than anything here can be", "give a smaller number")
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            yield Fault(at, f"'{key_name(at)}' has more digits than a 64-bit integer holds", "give a smaller number")


def _toml_problem(text: str, label: str, message: str) -> Problem:
    match = _AT.search(message)
    if text.lstrip().startswith("{"):
        top = text.partition("\n")[0]
        return Problem(label, 1, 1, "is JSON, and its name says TOML", "rename it to .json", top)
    if match is None:
        return Problem(label, 0, 0, f"is no TOML: {message}", "give a smaller number")
    lines = text.split("\n")
    line = int(match[1] or len(text.rstrip().split("\n")))
    source = lines[line - 1]
    column = int(match[2] or len(source.rstrip()) + 1)
    message = message[: match.start()]
    if message.startswith("Cannot"):  # a second time the same table or key; tomllib points behind it
        word, first = _repeated_key(lines, line)
        message = f"{word} stands here a second time{f', first in line {first}' if first else ''}"
        column = len(source) - len(source.lstrip()) + 1
        return Problem(label, line, column, message, "rename or remove one of the two", source)
    if message.startswith("Invalid initial character for a key part") and _in_inline_table(lines, line, column):
        return Problem(label, line, column, "an inline table goes on here, or ends with a comma", _INLINE, source)
    hint = next((remedy for beginning, remedy in _REMEDIES if message.startswith(beginning)), "")
    return Problem(label, line, column, message, hint, source)


def _in_inline_table(lines: list[str], line: int, column: int) -> bool:
    """Whether a brace is open before a place, of those on its line and on the lines of the value above."""
    before = "\n".join([*lines[: line - 1], lines[line - 1][: column - 1]])
    plain = re.sub(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'|#[^\n]*', "", before)
    return plain.count("{") > plain.count("}")


def _repeated_key(lines: list[str], line: int) -> tuple[str, int | None]:
    """The header or key of a line, and the line above that has it too; a key is looked for in its own table."""
    word = _word(lines[line - 1])
    for number in range(line - 1, 0, -1):
        above = _word(lines[number - 1])
        if above == word:
            return word, number
        if above.startswith("[") and not word.startswith("["):
            break
    return word, None


def _word(line: str) -> str:
    return line.partition("#" if line.lstrip().startswith("[") else "=")[0].strip()


def _json(text: str, label: str) -> dict[str, Any]:
    try:
        document = msgspec.json.decode(text)
    except msgspec.DecodeError as error:  # a ValidationError, for numbers out of range, is one of these
        message, _, place = str(error).partition(" (byte ")
        offset = int(place.rstrip(")") or len(text.rstrip().encode()))
        hint = "the file was cut short" if "truncated" in message else "write experiments by hand in TOML"
        at = len(text.encode()[:offset].decode(errors="ignore"))
        raise DocumentError([at_offset(label, text, at, message, hint)]) from None
    if not isinstance(document, dict):
        message = "is JSON, but no experiment: its top must be a table { ... }"
        raise refusal(label, message, "name a file that zenpark wrote")
    return document
