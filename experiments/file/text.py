"""From bytes to a document: what is no text, no TOML or no JSON is refused with the place and a remedy."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

import msgspec

from experiments.file.problems import DocumentError, Problem, at_offset

LARGEST: Final = 4_000_000  # bytes; a hundred robots take ten thousand
DEEPEST: Final = 50  # parts of a dotted key
_PART: Final = re.compile(r"""["']?[\w-]+["']?""")
_AT: Final = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_REMEDIES: Final = (
    ("Invalid value", 'text stands in quotes, as in kind = "crazyflie"; numbers have a point, not a comma'),
    ("Expected '='", "a line is key = value, or a [table]; a key with blanks or signs stands in quotes"),
    ("Unclosed array", "a list that begins above lacks its ]"),
    ("Unclosed inline table", "an inline table lacks its }, or a comma between two of its keys"),
    ("Unterminated string", "a text lacks its closing quotes"),
    ("Illegal character", "a text lacks its closing quotes, or holds a character that cannot be typed"),
    ("Expected newline", "one key = value in a line; text stands in quotes, a comment begins with #"),
    ("Expected ']", "a header is [table], or [[timeline]] with two brackets on both sides"),
    ("Invalid initial character", "a key is letters, digits, _ and -, or stands in quotes"),
    ("Unescaped '\\'", "write a backslash twice, or use single quotes"),
)


def content(file: Path, label: str) -> bytes:
    """The bytes of a file.

    Raises:
        FileNotFoundError: If there is none.
        DocumentError: If it is a folder, cannot be read, or is too long to be what it should be.
    """
    try:
        with file.open("rb") as stream:
            found = stream.read(LARGEST + 1)
    except FileNotFoundError:
        raise
    except IsADirectoryError:
        toml = sorted(each.name for each in file.glob("*.toml"))[:5]
        hint = f"name a file in it: {', '.join(toml)}" if toml else "name an experiment file"
        raise DocumentError([Problem(label, 0, 0, "is a folder", hint)]) from None
    except (OSError, ValueError) as error:
        hint = "check the name and who may read it"
        raise DocumentError([Problem(label, 0, 0, f"cannot be read: {reason(error)}", hint)]) from error
    if len(found) > LARGEST:
        hint = "name the experiment file, not a recording"
        raise DocumentError([Problem(label, 0, 0, f"is longer than {LARGEST // 1_000_000} MB", hint)])
    return found


def reason(error: OSError | ValueError) -> str:
    """What the system says is the matter."""
    return str(error.strerror) if isinstance(error, OSError) and error.strerror else str(error)


def decoded(content: bytes, label: str) -> str:
    """The text of a file, with plain line ends.

    Raises:
        DocumentError: If it is binary, empty or not UTF-8.
    """
    if b"\0" in content:
        raise DocumentError([Problem(label, 0, 0, "is binary, no text", "name an experiment file (.toml or .json)")])
    try:
        text = content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        readable = content.decode("utf-8", errors="replace").replace("\r\n", "\n")
        message = f"byte 0x{error.object[error.start]:02x} is not UTF-8"
        found = at_offset(label, readable, readable.index("\ufffd"), message, "save the file as UTF-8")
        raise DocumentError([found]) from None
    if not text.strip():
        raise DocumentError([Problem(label, 0, 0, "is empty", "zenpark new copies an experiment to begin with")])
    return text


def parsed(text: str, label: str, *, json: bool) -> dict[str, Any]:
    """The document that a text holds.

    Raises:
        DocumentError: If it is not well-formed.
        RecursionError: If it is nested too deeply.
    """
    return _json(text, label) if json else _toml(text, label)


def _toml(text: str, label: str) -> dict[str, Any]:
    if endless(text):
        hint = "no value of an experiment lies so deep; leave out what is too much"
        raise DocumentError([Problem(label, 0, 0, f"a key has more than {DEEPEST} parts", hint)])
    try:
        document = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise DocumentError([_toml_problem(text, label, str(error))]) from None
    if not document:
        hint = "zenpark new copies an experiment to begin with"
        raise DocumentError([Problem(label, 0, 0, "holds nothing but comments", hint)])
    return document


def endless(text: str) -> bool:
    """Whether a TOML text holds a key of very many parts, for which `tomllib` takes seconds and gigabytes."""
    run = 0
    for part in text.split("."):
        run = run + 1 if _PART.fullmatch(part.strip(" \t")) else 0
        if run > DEEPEST:
            return True
    return False


def _toml_problem(text: str, label: str, message: str) -> Problem:
    match = _AT.search(message)
    if match is None:
        return Problem(label, 0, 0, f"is no TOML: {message}", "give a smaller number")
    lines = text.split("\n")
    if match[1]:
        line, column = int(match[1]), int(match[2])
    else:
        line = len(text.rstrip().split("\n"))
        column = len(lines[line - 1].rstrip()) + 1
    message = message[: match.start()]
    if message.startswith("Cannot"):  # tomllib points behind the statement
        return _twice(label, lines, line)
    hint = next((remedy for beginning, remedy in _REMEDIES if message.startswith(beginning)), "")
    return Problem(label, line, column, message, hint, lines[line - 1])


def _twice(label: str, lines: list[str], line: int) -> Problem:
    """The same table or key a second time: by far the most usual when robots are copied."""
    source = lines[line - 1]
    header = source.lstrip().startswith("[")
    word = source.split("#")[0].strip() if header else source.partition("=")[0].strip()
    first = None
    for number in range(line - 1, 0, -1):
        above = lines[number - 1].strip()
        if (above.split("#")[0].strip() if header else above.partition("=")[0].strip()) == word:
            first = number
            break
        if not header and above.startswith("["):
            break
    place = f", first in line {first}" if first else ""
    column = len(source) - len(source.lstrip()) + 1
    return Problem(
        label, line, column, f"{word} stands here a second time{place}", "rename or remove one of the two", source
    )


def _json(text: str, label: str) -> dict[str, Any]:
    try:
        document = msgspec.json.decode(text)
    except msgspec.DecodeError as error:  # a ValidationError, for numbers out of range, is one of these
        message = str(error)
        match = re.search(r" \(byte (\d+)\)$", message)
        end = len(text.rstrip().encode())
        offset = len(text.encode()[: int(match[1]) if match else end].decode(errors="ignore"))
        hint = "the file was cut short" if "truncated" in message else "write experiments by hand in TOML"
        found = at_offset(label, text, offset, message[: match.start()] if match else message, hint)
        raise DocumentError([found]) from None
    if not isinstance(document, dict):
        message = "is JSON, but no experiment: its top must be a table { ... }"
        raise DocumentError([Problem(label, 0, 0, message, "name a file that zenpark wrote")])
    return document
