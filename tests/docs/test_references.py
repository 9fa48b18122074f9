"""References of README and docs exist: modules, names in them, files, and links between pages."""

from __future__ import annotations

import ast
import re
import runpy
from functools import cache
from pathlib import Path

from tests.cases import for_each
from tests.commands import ROOT

TOPS = ("agents", "bridges", "twins", "experiments", "tools")
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "bridges").rglob("*.md")])
DOTTED = re.compile(rf"(?<![\w./-])(?:{'|'.join(TOPS)})(?:\.\w+)+")
PATH = re.compile(rf"(?<![\w./-])(?:{'|'.join((*TOPS, 'docs', 'tests'))})/[\w./{{}},*-]*")
MADE = {"docs/tutorials/out"}  # by the lessons
SITE = {f"reference/{name}.md" for name in runpy.run_path(str(ROOT / "docs" / "site.py"))["PAGES"]}  # made with it
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


@cache
def names(module: Path) -> set[str]:
    """Names at the top of a module, and those of its classes with the class before them."""
    found: set[str] = set()
    for node in ast.parse(module.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for part in node.body for name in _defined(part)}
        found |= _defined(node)
    return found


def _defined(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return {node.name}
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    return set()


def exists(dotted: str) -> bool:
    """Whether a dotted name is a package, a module, or a name in one."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        rest = ".".join(parts[count:])
        if (file := place.with_suffix(".py")).is_file():
            return not rest or rest in names(file)
        if place.is_dir():
            return not rest
    return False


def expanded(path: str) -> list[str]:
    """Paths of one with alternatives in braces: a/{b,c}.py."""
    braces = re.search(r"\{([^}]*)\}", path)
    if braces is None:
        return [path]
    return [path[: braces.start()] + each + path[braces.end() :] for each in braces[1].split(",")]


@for_each("page", PAGES)
def test_what_a_page_refers_to_exists(page):
    text = page.read_text("utf-8")
    dotted = {found[0] for found in DOTTED.finditer(text) if not found[0].endswith((".py", ".toml", ".md"))}
    paths = {each for found in PATH.finditer(text) for each in expanded(found[0].rstrip(".,"))} - MADE
    links = {found[1] for found in LINK.finditer(text) if "://" not in found[1]}
    lost = [name for name in dotted if not exists(name)]
    lost += [path for path in paths if not any(ROOT.glob(path.rstrip("/")))]
    lost += [link for link in links - SITE if not (page.parent / link).exists()]
    assert not sorted(lost)
