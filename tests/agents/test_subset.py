"""Quiet functions stay within the subset of Python that sweeps compile, and a tick calls few of them."""

import ast
import inspect
import sys
from collections import Counter
from pathlib import Path
from textwrap import dedent

import pytest

from agents.plugins import registry
from agents.plugins.laws import Gradient
from agents.plugins.registry import AVOIDANCES, LAWS, PREDICTORS, TRIGGERS
from experiments.virtual_time.source import faults
from tests.agents.bench import Swarm, drone
from tests.commands import ROOT
from tests.small import NOISY, pair

QUIET = (
    "decision/control_updates", "decision/position_control", "plugins/barrier", "plugins/laws", "plugins/predictors",
    "plugins/trigger_families", "plugins/triggers", "safety/motion_check", "safety/positions",
    "safety/setpoint_filter", "vectors",
)  # fmt: skip
# functions of quiet modules that are not quiet themselves, each with the reason
RARE = {
    **{f"agents/{name}.py": frozenset() for name in QUIET},
    "agents/plugins/avoidance.py": {"Nearby.reserve"},  # grows its list of things, outside of ticks
    "agents/decision/transmission.py": {"Transmitter.replace_trigger"},  # an order
    **{str(path.relative_to(ROOT)): set() for path in sorted((ROOT / "twins" / "models").glob("*.py"))},
    "twins/models/quadrotor.py": {"Quadrotor.place"},  # puts a robot somewhere
    # random numbers are drawn in blocks, outside of ticks
    "twins/models/noise.py": {"stream", "refill", "Noise.refill", "Noise.reserve", "Noise._drawn"},
}


def functions(tree: ast.AST, prefix=""):
    """Functions of a module or class with their names; constructors, properties and class methods are not quiet."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from functions(node, f"{node.name}.")
        elif isinstance(node, ast.FunctionDef) and node.name != "__init__" and not node.decorator_list:
            yield prefix + node.name, node


def outside(source: str, rare=frozenset(), first=1):
    """Line, function and fault of all that the subset has not."""
    quiet = [(name, function) for name, function in functions(ast.parse(source)) if name not in rare]
    return [(line + first - 1, name, fault) for name, function in quiet for line, fault in faults(function)]


@pytest.mark.parametrize("file", RARE)
def test_quiet_functions_stay_in_the_subset(file):
    source = (ROOT / file).read_text(encoding="utf-8")
    assert outside(source, RARE[file]) == []
    assert RARE[file] <= {name for name, _ in functions(ast.parse(source))}, "it is there"


COMPILED = [
    kind
    for group in (LAWS, TRIGGERS, PREDICTORS, AVOIDANCES)
    for kind in (registry.struct(group, name) for name in registry.names(group))
    if kind.__module__.startswith("agents.") and (group != LAWS or issubclass(kind, Gradient))
]


@pytest.mark.parametrize("kind", COMPILED)
def test_plugins_of_zenpark_stay_in_the_subset(kind):
    """Plug-ins of others may leave the subset and run as plain Python, as do laws that remember."""
    source, first = inspect.getsourcelines(kind)
    assert outside(dedent("".join(source)), first=first) == []


SAMPLE = '''
class Odd:
    def fires(self, view):
        """Text is allowed here."""
        try:
            return any(x > 1 for x in view.places) or view.last is None
        except ValueError:
            return f"{view}"

    def position(self, *poses):
        return {"x": 0.0}

    def must(self):
        raise TypeError("must define `must`")
'''


def test_faults_are_found_with_their_lines():
    found = {(line, fault) for line, _, fault in outside(SAMPLE)}
    assert found == {
        (5, "try"), (6, "a call of any"), (6, "a generator"), (6, "None"), (8, "an f-string"), (10, "*args"),
        (11, "a dictionary"), (11, "the text 'x'"),
    }  # fmt: skip


TICKS = 20  # two decisions


@pytest.mark.parametrize(("name", "different", "calls"), [("F", 45, 46), ("A", 49, 50)])
def test_tick_calls_few_functions(name, different, calls):
    """With cold caches, each different function of the project costs a robot 2 µs (docs/results/cost.md)."""
    swarm = (drone(disturbance=NOISY) if name == "F" else Swarm(pair(disturbance=NOISY))).running().run(1.0)
    (group, row), counted, before = swarm.where[name], Counter(), sys.getprofile()

    def count(frame, event, _):
        file = Path(frame.f_code.co_filename)
        if event == "call" and not {"agents", "twins"}.isdisjoint(file.parts[:-1]):
            counted[f"{file.stem}:{frame.f_code.co_qualname}"] += 1

    for _ in range(TICKS):
        sys.setprofile(count)
        (state,) = group.body.read(swarm.t)
        group.robots[row].transmit(swarm.t, state)
        group.robots[row].act(swarm.t)
        group.body.command([group.robots[row].setpoint])
        sys.setprofile(before)
        swarm.tick += 1
    assert len([each for each, number in counted.items() if number >= TICKS / 2]) <= different, counted
    assert counted.total() / TICKS <= calls, counted
