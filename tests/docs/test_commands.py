"""Commands and experiment files that stand in README and docs: the command line knows each, the files are valid."""

from __future__ import annotations

import re
import shlex

import pytest
import typer.main

from experiments.check.check import check
from experiments.file import document
from tests.__main__ import MEASUREMENTS
from tests.__main__ import command as measurement
from tests.commands import ROOT
from tests.docs.test_references import PAGES, TOPS
from tools.main import app

COMMAND = re.compile(r"^ {4,}\./zenpark (?P<words>[^#\n]*)", re.MULTILINE)
BLOCK = re.compile(r"^```toml\n(title = .*?)^```", re.MULTILINE | re.DOTALL)
COMMAND_LINE = typer.main.get_command(app)
MEASURING = {option: typer.main.get_command(measurement(option)) for option in MEASUREMENTS}  # behind `./zenpark test`


def commands(page) -> list[str]:
    """Commands in the blocks of a page, without what a shell does with their input and output."""
    text = page.read_text("utf-8").replace("\\\n", " ")
    return [re.split(r" [|>&]", found["words"])[0].strip() for found in COMMAND.finditer(text)]


def parse(words: list[str]) -> None:
    """Raises a usage error if the command line does not know a command or an option."""
    command, name = COMMAND_LINE, "zenpark"
    if words[:1] == ["test"] and MEASURING.keys() & words[1:2]:
        (_, name, *words), command = words, MEASURING[words[1]]
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name, *words = words
        command = command.commands[name]
    command.make_context(name, words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_command_line_knows_every_command_of_a_page(page):
    for text in commands(page):
        words = shlex.split(text)
        if words and "--help" not in words:
            parse(words)


SOURCES = [path for top in (*TOPS, "docs") for path in (ROOT / top).rglob("*") if path.suffix in {".py", ".md"}]
BARE = re.compile(rf"(?:^ +|`)zenpark (?:{'|'.join(COMMAND_LINE.commands)})\b.*", re.MULTILINE)


def test_commands_are_written_as_they_can_be_copied():
    texts = {path: path.read_text("utf-8") for path in [*SOURCES, ROOT / "README.md"]}
    assert [f"{path}: {found[0]}" for path, text in texts.items() for found in BARE.finditer(text)] == []


def _leaves(command, path=()):
    """Visible commands without commands of their own, by their words."""
    below = getattr(command, "commands", {})
    if not below:
        yield path, command
    for name, each in below.items():
        if not each.hidden:
            yield from _leaves(each, (*path, name))


LEAVES = dict(_leaves(COMMAND_LINE)) | {("test", option): command for option, command in MEASURING.items()}


@pytest.mark.parametrize(("path", "command"), LEAVES.items(), ids=map(" ".join, LEAVES))
def test_help_of_commands_ends_with_valid_examples(path, command):
    lines = [line.strip() for line in (command.epilog or "").splitlines() if "./zenpark" in line]
    assert lines
    for line in lines:
        words = shlex.split(line.partition(" > ")[0])
        assert (words[0], tuple(words[1 : 1 + len(path)])) == ("./zenpark", path)
        if "--help" not in words:
            parse(words[1:])


@pytest.mark.slow
@pytest.mark.parametrize("flown", [False, pytest.param(True, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_experiments_of_a_page_are_sound(page, flown, request):
    if not flown:
        request.getfixturevalue("unflown")
    for text in BLOCK.findall(page.read_text("utf-8")):
        assert [str(found) for found in check(document.loads(text)) if found.severity == "error"] == []
