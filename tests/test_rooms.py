"""The floor plan holds: imports go one way and in no circle, rooms are neither too full nor too small, names short."""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOPS = ("agents", "twins", "bridges", "experiments", "tools")
MOST, LEAST = 12, 60  # modules of a folder; lines of a module that only one other imports
MOST_WORDS = 8  # of a test's name
# Each line imports from lines above it and within each of its own folders.
ORDER = """
agents.errors agents.fields agents.vectors
agents.clock agents.ticks agents.user_folder
agents.formation agents.network
agents.plugins
agents.body
agents.kinds
agents.decision
agents.safety
agents.robot
agents.runtime
twins.arrays
twins.models twins.scene
twins.engines
twins.sensing
twins.body
twins.device
bridges.measured_flight bridges.ros2
DEVICES
experiments.arrays experiments.catalogue experiments.cores
experiments.definition
experiments.file
experiments.recording
experiments.metrics
experiments.scene
experiments.virtual_time
experiments.check
experiments.authoring experiments.real_time.processes
experiments.real_time.hosts
experiments.report experiments.real_time.conductor
experiments.run
experiments.course experiments.sweep experiments.view experiments.learning
experiments.api
tools.terminal
tools.live_table tools.consent
tools.progress tools.completion
tools.options
tools.commands
tools.main
tools.guard
"""
# laws whose libraries take arrays: they import numpy with them, at first use
EXTRAS = ("agents.plugins.extras.mpc", "agents.plugins.extras.policy")
# a line of ORDER, in which none imports another: the folders of bridges, but for one that has a line of its own
DEVICES = ["external", *(each.parent.name for each in (ROOT / "bridges").glob("*/__init__.py"))]
DEVICES.remove("ros2")
FLOORS = [
    [f"bridges.{name}" for name in DEVICES] if line == "DEVICES" else line.split()
    for line in ORDER.strip().splitlines()
]


@cache
def modules() -> dict[str, Path]:
    """Modules of the five top folders, by dotted name, without `__init__`."""
    files = (file for top in TOPS for file in (ROOT / top).rglob("*.py") if file.name != "__init__.py")
    return {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in files}


@cache
def texts() -> dict[str, str]:
    return {name: file.read_text("utf-8") for name, file in modules().items()}


@cache
def statements(name: str) -> tuple[list[ast.Import | ast.ImportFrom], list[str]]:
    """Statements of a module that import, and names of its classes, wherever they stand."""
    nodes = list(ast.walk(ast.parse(texts()[name])))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    return imports, [node.name for node in nodes if isinstance(node, ast.ClassDef)]


def imported(nodes: Iterable[ast.AST]) -> set[str]:
    """Dotted names that statements import: modules, and what is imported from them."""
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


@cache
def imports() -> dict[str, set[str]]:
    """Imports of each module, wherever they stand: late ones as well."""
    return {name: imported(statements(name)[0]) & modules().keys() - {name} for name in modules()}


def importing(*packages: str) -> set[str]:
    """Modules that import one of these packages, wherever that stands."""
    return {
        name for name in modules() if {each.partition(".")[0] for each in imported(statements(name)[0])} & {*packages}
    }


def room(name: str) -> str:
    """The entry of ORDER that a module belongs to."""
    found = [entry for floor in FLOORS for entry in floor if f"{name}.".startswith(f"{entry}.")]
    assert len(found) == 1, f"{name} has no place in the order of the folders, or several: {found}"
    return found[0]


def floor_of(entry: str) -> int:
    return next(number for number, floor in enumerate(FLOORS) if entry in floor)


def test_names_of_classes_stand_once():
    homes = defaultdict(list)
    for module in modules():
        for name in statements(module)[1]:
            homes[name].append(module)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def test_imports_go_one_way():
    against = [
        f"{name} imports {other}"
        for name, others in imports().items()
        for other in others
        if room(name) != room(other) and floor_of(room(other)) >= floor_of(room(name))
    ]
    assert not against


# what imports a device although it is none, and why
IMPORTS_DEVICES = {"experiments.authoring.crazyswarm": "importer of files that list Crazyflies"}


def test_core_imports_no_device():
    """Without the folder of a device the core and the other devices are whole, as `test_imports_go_one_way` asks."""
    users = {name for name, others in imports().items() if any(other.startswith("bridges.") for other in others)}
    assert {name for name in users if not name.startswith("bridges.")} == IMPORTS_DEVICES.keys()


def test_gallery_imports_zenpark_alone():
    """Laws of the literature, and those with heavy libraries, import `zenpark` and none of our modules but siblings."""
    foreign = [
        f"{name} imports {other}"
        for name, others in imports().items()
        if name.startswith(("agents.plugins.gallery.", "agents.plugins.extras."))
        for other in others
        if other.rpartition(".")[0] != name.rpartition(".")[0]
    ]
    assert not foreign


def test_no_circle():
    try:
        TopologicalSorter(imports()).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_robots_compute_without_arrays():
    with_arrays = {name for name in importing("numpy") if name.startswith(("agents.", "twins.models."))}
    assert with_arrays <= {"twins.models.noise", *EXTRAS}
    assert not [name for name in EXTRAS if "numpy" in imported(ast.parse(texts()[name]).body)]


def test_no_folder_is_too_full():
    count = Counter(file.parent for file in modules().values())
    assert [str(folder) for folder, inside in count.items() if inside > MOST] == []


def test_no_module_is_a_mere_part_of_another():
    importers: dict[str, set[str]] = {name: set() for name in modules()}
    for name, others in imports().items():
        for other in others:
            importers[other].add(name)
    # what `python -m` starts, what holds commands, and what entry points name stands alone
    entries = {
        name
        for name, text in texts().items()
        if re.search(r'^if __name__ == "__main__":|= typer\.Typer\(\)', text, re.M)
    }
    entries |= set(re.findall(rf'= "((?:{"|".join(TOPS)})[\w.]*):', (ROOT / "pyproject.toml").read_text("utf-8")))
    small = [
        f"{name} belongs into {next(iter(users))}"
        for name, users in importers.items()
        if len(users) == 1 and len(texts()[name].splitlines()) < LEAST and name not in entries
    ]
    assert not small


def test_folders_describe_themselves_and_import_what_they_say():
    silent, beyond = [], []
    for folder in sorted({file.parent for file in modules().values()}):
        tree = ast.parse((folder / "__init__.py").read_text("utf-8"))
        says = re.search(r"\n\n(?:.*\n)?May import: ([\w., \n]+)\.$", ast.get_docstring(tree) or "")
        if says is None or len(tree.body) > 1:
            silent.append(str(folder.relative_to(ROOT)))
            continue
        named = [name for name in re.split(r",\s+", says[1]) if name != "nothing"]
        assert not [name for name in named if not any(f"{each}.".startswith(f"{name}.") for each in modules())]
        may = tuple(f"{name}." for name in named)
        inside = {name for name, file in modules().items() if file.parent == folder}
        others = {(name, to) for name in inside for to in imports()[name] - inside}
        beyond += [f"{name} imports {to}" for name, to in sorted(others) if not f"{to}.".startswith(may)]
    assert not silent, "each __init__.py is a docstring: what lives there, and its last lines 'May import: ...'"
    assert not beyond, "the folder's __init__.py does not name that"


# where an experiment is read and compiled: all others get a plan
SEES_EXPERIMENTS = ("experiments.definition", "experiments.file", "experiments.authoring")
COMPILES = {"experiments.definition.plan", "experiments.file.document"}
CHOOSES_PLUGINS = {
    "experiments.course.cells",  # class of a group, in its process
    "experiments.definition.plan",
    "experiments.file.choices",  # structs of parameters, for the reader
    "experiments.metrics.metric",
}


def calling(call: str) -> set[str]:
    """Modules that call one of these functions, by their dotted names."""
    called = re.compile(rf"(?<![\w.])(?<!class )(?:{call})\(")
    return {name for name, text in texts().items() if called.search(text)}


def test_experiments_are_compiled_once():
    seen = {n for n in modules() if "experiments.definition.experiment.Experiment" in imported(statements(n)[0])}
    assert not {name for name in seen if not name.startswith(SEES_EXPERIMENTS)}, "take a Plan"
    assert calling("Plan") == COMPILES


def test_plug_ins_are_chosen_in_one_place():
    assert calling(r"registry\.(?:build|split|struct)") == CHOOSES_PLUGINS


def test_test_names_are_short_and_unique():
    definition = re.compile(r"^ *(?:async )?def test_(\w+)", re.MULTILINE)
    names_of = {file: definition.findall(file.read_text("utf-8")) for file in (ROOT / "tests").rglob("test_*.py")}
    long = [name for names in names_of.values() for name in names if name.count("_") >= MOST_WORDS]
    assert not long, f"at most {MOST_WORDS} words: the subject first, then what happens"
    assert not [file for file, names in names_of.items() if len(set(names)) < len(names)], "names stand twice"


# what names a kind outside of its own files, and why; all others ask its `Kind`
NAMES_KINDS = {
    "experiments.authoring.crazyswarm": "drones of another project",
    "experiments.authoring.generate": "kind of a new formation, if none is asked for",
    "experiments.authoring.robotic_park.file": "drivers of another project, by their robots",
    "experiments.definition.experiment": "example in a text",
    "experiments.file.reference": "example in a text",
    "experiments.file.structure": "example in a text",
    "experiments.file.text": "example in a text",
    "experiments.real_time.hosts.station": "page on radios",
    "experiments.scene.models": "pictures, by their kinds",
    "tools.commands.author": "kind of a new formation, if none is asked for",
    "tools.commands.hosts": "watchdog, a program for one robot",
    "tools.commands.processes": "example in a text",
}
OWN_OF_KINDS = ("agents.kinds.", "bridges.")


def test_kinds_stand_in_their_own_files():
    word = re.compile(r"\b(?:crazyflie|khepera4|tello|turtlebot3)\b", re.IGNORECASE)
    naming = {
        name
        for name, text in texts().items()
        if not name.startswith(OWN_OF_KINDS) and word.search(text)
        for node in ast.walk(ast.parse(text))
        if (isinstance(node, ast.Name | ast.alias) and word.search(ast.unparse(node)))
        or (isinstance(node, ast.ImportFrom) and word.search(node.module or ""))
        or (isinstance(node, ast.FunctionDef) and word.search(node.name))
        or (isinstance(node, ast.Constant) and isinstance(node.value, str) and re.search(word.pattern, node.value))
    }
    assert naming == NAMES_KINDS.keys()


def test_modules_read_the_module_time():
    """A test, or a simulation, that replaces a function of `time` replaces it everywhere."""
    named = [name for name, text in texts().items() if re.search(r"^\s*from time import", text, re.MULTILINE)]
    assert not named
