"""Exercises of a course, made from its solved files.

A course is a folder of experiment files, of the laws that they name, and of what else these need. What is to be filled
in stands there solved, between two comments, of which the first has what stands in the exercise instead:

    # blank: ...  # add the way from x to the x of `each.position`
    to_x += each.position[0] - x
    # end of blank
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from agents.errors import ExplainedError
from agents.plugins.files import MAX_FILE_BYTES
from experiments.file.document import inline
from experiments.file.text import content, parsed

OURS: Final = Path(__file__).parents[2] / "docs" / "course"  # course of zenpark, in a checkout
_BLANK: Final = re.compile(r"^( *)# blank: (.*)\n(?:.*\n)*?^ *# end of blank\n", re.MULTILINE)
_PLUGIN: Final = re.compile(r"[\"']([^\"':/\\]+\.py):(\w+)[\"']")  # class in a Python file that an experiment names
NAMED: Final = (("links",), ("shape",))  # tables in which groups may use names that the solution does not
Table = Mapping[str, Any]


class CourseError(ExplainedError, ValueError):
    """A course, or what was handed in, that cannot be used."""


@dataclass(frozen=True)
class Exercise:
    """Exercise: an experiment file with blanks, and with criteria that judge how they are filled in.

    Attributes:
        name: Of the file, without its suffix.
        laws: Names of the Python files with blanks that it names.
        classes: Those in these files that it names, each as `law.py:Meet`.
        blanks: Paths of the values in the file, or of tables with more keys, that are to be filled in.
        posed: Content of the file with the blanks.
        solved: Content of the file with the solution.
    """

    name: str
    laws: tuple[str, ...]
    classes: tuple[str, ...]
    blanks: tuple[tuple[str, ...], ...]
    posed: Table
    solved: Table

    @property
    def file(self) -> str:
        """Name of the experiment file."""
        return f"{self.name}.toml"

    @property
    def parts(self) -> list[str]:
        """Names of the files that hold blanks."""
        return [*([self.file] if self.blanks else []), *self.laws]

    @property
    def criteria(self) -> int:
        """Number of criteria."""
        return len(self.posed.get("criteria", ()))

    def filled(self, text: str, label: str) -> list[str]:
        """Values for the blanks in a text of this file, as `path=value`; all else in it is left out.

        Raises DocumentError for a text that is no TOML, CourseError for a value that no experiment holds.
        """
        given = parsed(text, label, json=False)
        try:
            return [f"{_dotted(path)}={inline(value)}" for path, value in self._filled(given)]
        except TypeError as error:
            raise CourseError(f"{label}: {error}; give a number, a text, a list or a table") from None

    def _filled(self, given: Table) -> Iterator[tuple[tuple[str, ...], Any]]:
        for path in self.blanks:
            asked, value = _at(self.posed, path), _at(given, path)
            if isinstance(asked, Mapping) and isinstance(value, Mapping):
                keys = value if path[-1:] in NAMED else _at(self.solved, path)
                yield from (((*path, key), value[key]) for key in keys if key in value and key not in asked)
            elif value is not None:
                yield path, value


@dataclass(frozen=True)
class Course:
    """Exercises by name, and all files as students get them."""

    exercises: Mapping[str, Exercise]
    files: Mapping[str, str]
    solved: Mapping[str, str]
    models: Mapping[str, bytes]  # learned models that stand in the folder, of solutions and others

    @property
    def given(self) -> Mapping[str, bytes]:
        """Models that its exercises name, and groups get."""
        return {name: model for name, model in self.models.items() if any(name in each for each in self.files.values())}


def posed(text: str) -> str:
    """A solved text with its blanks empty."""
    return _BLANK.sub(r"\1\2\n", text)


def read_course(folder: Path) -> Course:
    """The course in a folder; raises CourseError if it has no exercise."""
    names = sorted(file.name for pattern in ("*.toml", "*.py") for file in folder.glob(pattern))
    solved = {name: content(folder / name, str(folder / name)) for name in names}
    files = {name: posed(text) for name, text in solved.items()}
    exercises = {}
    for name in names:
        if not name.endswith(".toml"):
            continue
        asked, answer = (parsed(texts[name], str(folder / name), json=False) for texts in (files, solved))
        named = [each for each in _PLUGIN.findall(solved[name]) if files.get(each[0]) != solved.get(each[0])]
        if named or asked != answer:
            stem = name.removesuffix(".toml")
            laws, classes = dict.fromkeys(file for file, _ in named), dict.fromkeys(map(":".join, named))
            exercises[stem] = Exercise(stem, tuple(laws), tuple(classes), tuple(_blanks(asked, answer)), asked, answer)
    if not exercises:
        place = "is no folder" if not folder.is_dir() else "holds no exercise"
        raise CourseError(
            f"{folder} {place}; name one of files with `# blank: ...` and `# end of blank` (docs/teaching.md)"
        )
    return Course(exercises, files, solved, read_models(folder))


def read_models(folder: Path) -> dict[str, bytes]:
    """Learned models in a folder, by the names of their files; those that are too large are left out."""
    found = {}
    for file in sorted(folder.glob("*.onnx")):
        if file.is_file() and file.stat().st_size <= MAX_FILE_BYTES:  # a pipe would be waited for
            found[file.name] = file.read_bytes()
    return found


def write_exercises(course: Course, folder: Path) -> None:
    """Write the exercises into a folder, which is made; raises CourseError for one that has such files."""
    texts, models = course.files, course.given
    if known := sorted(name for name in (*texts, *models) if (folder / name).exists()):
        raise CourseError(f"{folder / known[0]} is there already; name another folder")
    write({**texts, **models}, folder)


def write(files: Mapping[str, str | bytes], folder: Path) -> None:
    """Write texts, or bytes, by their names into a folder, which is made; raises CourseError if that cannot be done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    except OSError as error:
        raise CourseError(f"{error.filename}: cannot be written: {error.strerror}; name another folder") from None


def _blanks(asked: Table, answer: Table, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths at which two documents differ: of a value, or of the table that has other keys."""
    if asked.keys() != answer.keys():
        yield path
    for key in asked.keys() & answer.keys():
        one, other = asked[key], answer[key]
        if isinstance(one, dict) and isinstance(other, dict):
            yield from _blanks(one, other, (*path, key))
        elif one != other:
            yield (*path, key)


def _at(document: Any, path: tuple[str, ...]) -> Any:  # noqa: ANN401 - a value of a file
    """The value at a path; None if there is none."""
    for key in path:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document


def _dotted(path: tuple[str, ...]) -> str:
    return ".".join(f'"{key}"' for key in path)
