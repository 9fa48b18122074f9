"""The names of `zenpark`: each has an example on its page, which runs; guides import from there alone."""

import ast
import linecache
import os
import re
import sys
from pathlib import Path

import pytest

import zenpark
from experiments import api
from tests.cases import for_each
from tests.commands import ROOT, environment, python
from tests.docs.test_pages import PAGES

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGE = (ROOT / "docs" / "python.md").read_text("utf-8")
PROGRAMS = [*(ROOT / "docs" / "tutorials").rglob("*.py"), *(ROOT / "docs" / "course").rglob("*.py")]
CODE = {page: BLOCK.findall(page.read_text("utf-8")) for page in PAGES}
CODE |= {file: [file.read_text("utf-8")] for file in PROGRAMS}
# what a plug-in that flies may import: nothing of it needs numpy or anything of `experiments`
FLYING = """
Law, Gradient, Control, Measure, Memory, Said, View, RobotFacts, Link, BY_DISTANCE, BY_RELATIVE, BY_BEARING, BY_NOTHING,
PluginError, Trigger, Predictor, Planner,
Avoidance, measure_gap, Kind, KINDS, Ground, Body, BodyRequest, BodyState, BodyError,
Wheels, Steered, Holonomic, Flight, call_all, Vector, norm, distance, clamp, wrap
""".replace("\n", "")


def imported(tree: ast.AST) -> dict[str, str]:
    """Names that code imports, with their modules."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {alias.name: node.module or "" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name: alias.name for alias in node.names}
    return found


def test_every_name_has_a_type_and_a_home():
    tree = ast.parse(Path(api.__file__).read_text("utf-8"))
    (typed,) = [node for node in tree.body if isinstance(node, ast.If)]
    assert imported(typed) == api.homes()
    assert sorted(zenpark.__all__) == sorted(api.homes()) == dir(zenpark)
    assert None not in [getattr(zenpark, name) for name in zenpark.__all__]
    rows = re.search(r"^Fifteen names.*\n\n((?:\|.*\n)+)", PAGE, re.MULTILINE)[1]
    assert re.findall(r"`(\w+)`", rows) == zenpark.__all__[:15]
    with pytest.raises(AttributeError, match="no attribute 'Gradent'; did you mean 'Gradient'"):
        _ = zenpark.Gradent


@pytest.mark.slow
def test_examples_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["page", str(tmp_path / "figures")])
    monkeypatch.setenv("ZENPARK_RUNTIME_DIR", str(tmp_path / "runs"))
    space: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(BLOCK.findall(PAGE)):
        name = f"docs/python.md, block {number}"
        monkeypatch.setitem(linecache.cache, name, (len(block), None, block.splitlines(keepends=True), name))
        exec(compile(block, name, "exec"), space)
    assert (tmp_path / "figures" / "python-errors.pdf").exists()


def test_every_name_has_an_example():
    used: set[str] = set()
    for block in BLOCK.findall(PAGE):
        tree = ast.parse(block)
        names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        used |= {name for name, module in imported(tree).items() if module == "zenpark" and name in names}
    assert used == {*zenpark.__all__}


@for_each("place", [place for place, blocks in CODE.items() if blocks])
def test_guides_import_from_nowhere_else(place):
    """But what twins of devices are made of, and locks for other programs, are no part of `zenpark`."""
    ours = re.compile(r"(agents(?!\.body\.device_locks$)|bridges|experiments|tools)\b")
    for each in CODE[place]:
        elsewhere = {name: home for name, home in imported(ast.parse(each)).items() if ours.match(home)}
        assert not elsewhere, "import it from zenpark (experiments/api.py, docs/python.md)"


@pytest.mark.nightly
def test_type_checkers_know_the_names(tmp_path):
    """In a folder of the user's own, by what is installed."""
    laws = [block for block in BLOCK.findall(PAGE) if "Clock(Law" in block or "Rope(Gradient" in block]
    (tmp_path / "laws.py").write_text("\n".join([*laws, "from zenpark import nonsense", "wrong: int = norm(robot)"]))
    done = python("-m", "mypy", "--strict", "laws.py", cwd=tmp_path, env=None, code=None)
    found = re.findall(r"\[([a-z-]+)\]$", done.stdout, re.MULTILINE)
    assert found == ["attr-defined", "assignment", "arg-type"], done.stdout


def loaded(program: str) -> set[str]:
    """Modules that a process has that runs a program in a folder of its own."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "face")])
    done = python("-c", f"{program}\nimport sys\nprint(*sys.modules)", cwd="/", env=environment(PYTHONPATH=path))
    return set(done.stdout.split())


def test_robot_plugins_load_only_what_they_name():
    own = {"zenpark", "experiments", "experiments.api"}
    assert loaded("import zenpark") == loaded("import __future__, functools, importlib, typing") | own
    modules = loaded(f"from zenpark import {FLYING}")
    assert "numpy" not in modules
    assert {name for name in modules if name.startswith("experiments")} == {"experiments", "experiments.api"}
