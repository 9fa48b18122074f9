"""What README and docs refer to exists: modules, files, links, commands, experiments and the unit of systemd."""

import ast
import pkgutil
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from functools import cache

import pytest
import typer.main

from experiments.check.check import check
from experiments.file import document
from tests.__main__ import MEASUREMENTS
from tests.__main__ import command as measurement
from tests.cases import for_each
from tests.commands import ROOT
from tools.main import app

TOPS = ("agents", "bridges", "twins", "experiments", "tools")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "bridges").rglob("*.md")])
DOTTED = re.compile(rf"(?<![\w./-])(?:{'|'.join(TOPS)})(?:\.\w+)+")
PATH = re.compile(rf"(?<![\w./-])(?:{'|'.join((*TOPS, 'docs', 'tests'))})/[\w./{{}},*-]*")
MADE = {"docs/tutorials/out"}  # by the lessons
SITE = {f"reference/{name}.md" for name in runpy.run_path(str(ROOT / "docs" / "site.py"))["PAGES"]}  # made with it
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
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


def test_every_command_has_a_page():
    text = "".join(page.read_text("utf-8") for page in PAGES)
    missing = [name for name in COMMAND_LINE.commands if not re.search(rf"\./zenpark {name}\b", text)]
    assert not missing, "no page in docs shows ./zenpark with these"


@for_each("page", PAGES)
def test_command_line_knows_every_command_of_a_page(page):
    for text in commands(page):
        words = shlex.split(text)
        if words and "--help" not in words:
            parse(words)
    bare = re.compile(rf"(?:^ +|`)zenpark (?:{'|'.join(COMMAND_LINE.commands)})\b.*", re.MULTILINE)
    assert bare.search(page.read_text("utf-8")) is None  # it cannot be copied


def _leaves(command, path=()):
    """Visible commands without commands of their own, by their words."""
    below = getattr(command, "commands", {})
    if not below:
        yield path, command
    for name, each in below.items():
        if not each.hidden:
            yield from _leaves(each, (*path, name))


LEAVES = dict(_leaves(COMMAND_LINE)) | {("test", option): command for option, command in MEASURING.items()}


@for_each("path, command", LEAVES.items())
def test_help_of_commands_ends_with_valid_examples(path, command):
    lines = [line.strip() for line in (command.epilog or "").splitlines() if "./zenpark" in line]
    assert lines
    for line in lines:
        words = shlex.split(line.partition(" > ")[0])
        assert (words[0], tuple(words[1 : 1 + len(path)])) == ("./zenpark", path)
        if "--help" not in words:
            parse(words[1:])


@pytest.mark.slow
@pytest.mark.usefixtures("unflown")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_experiments_of_a_page_are_sound(page):
    for text in BLOCK.findall(page.read_text("utf-8")):
        assert [str(found) for found in check(document.loads(text)) if found.severity == "error"] == []


UNIT = re.search(r"```ini\n(\[Unit\].*?)```", (ROOT / "docs" / "hosts.md").read_text("utf-8"), re.DOTALL)[1]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze: apt-get install systemd")
def test_systemd_takes_the_unit_of_hosts(tmp_path):
    text = re.sub(r"ExecStart=\S+", f"ExecStart={sys.executable}", UNIT).replace("User=pi", "User=root")
    file = tmp_path / "zenpark@CF01.service"
    file.write_text(text)
    command = ["systemd-analyze", "verify", "--man=no", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    assert file.name not in done.stderr


def test_command_line_knows_the_unit_of_hosts():
    (line,) = re.findall(r"^ExecStart=\S+ (.*)$", UNIT, re.MULTILINE)
    assert line.startswith("agent join %i ")
    parse(shlex.split(line.replace("%i", "CF01")))  # as systemd does


def exists(dotted: str) -> bool:
    try:
        pkgutil.resolve_name(dotted)
    except (ImportError, AttributeError):
        return False
    return True


def expanded(path: str) -> list[str]:
    """Paths of one with alternatives in braces: a/{b,c}.py."""
    braces = re.search(r"\{([^}]*)\}", path)
    if braces is None:
        return [path]
    return [path[: braces.start()] + each + path[braces.end() :] for each in braces[1].split(",")]


@cache
def names_of_tests() -> set[str]:
    found = {"test_"}
    for file in (ROOT / "tests").rglob("test_*.py"):
        found |= {file.stem, *re.findall(r"^def (test_\w+)", file.read_text("utf-8"), re.MULTILINE)}
    return found


@for_each("page", PAGES)
def test_what_a_page_refers_to_exists(page):
    text = page.read_text("utf-8")
    dotted = {found[0] for found in DOTTED.finditer(text) if not found[0].endswith((".py", ".toml", ".md"))}
    paths = {each for found in PATH.finditer(text) for each in expanded(found[0].rstrip(".,"))} - MADE
    links = {found[1] for found in LINK.finditer(text) if "://" not in found[1]}
    lost = [name for name in dotted if not exists(name)]
    lost += [path for path in paths if not any(ROOT.glob(path.rstrip("/")))]
    lost += [link for link in links - SITE if not (page.parent / link).exists()]
    lost += {*re.findall(r"`(test_\w+)\W", text)} - names_of_tests()
    assert not sorted(lost)


NAMED = {"not-random", "device", "drives-apart", "centralised", "hybrid"}  # codes that stand in constants


def codes_of_findings():
    for file in (ROOT / "experiments" / "check").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding":
                code = node.args[1]
                assert isinstance(code, ast.Constant) or ast.unparse(code) in {
                    "what",
                    "NOT_RANDOM",
                    "DEVICE",
                    "APART",
                }, file
                yield from {code.value} if isinstance(code, ast.Constant) else NAMED


def test_codes_stand_in_docs_and_tests():
    codes = {*codes_of_findings()}
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / "check.md").read_text("utf-8"), re.MULTILINE)
    assert codes == {code for row in rows for code in re.findall(r"`([\w-]+)`", row)}
    tests = "".join(file.read_text("utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    assert {code for code in codes if f'"{code}"' not in tests} == set()
