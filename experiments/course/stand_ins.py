"""Stand-ins for the laws and triggers of a group: they look like the solution's, and ask cells what to do.

The flight, the messages, the errors of links and all that is judged are computed here, by the classes of the course;
a cell says what its robot does next. It sees what its questions hold, see `experiments.course.cells`.
"""

from __future__ import annotations

import ast
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from agents.fields import fields_of
from agents.formation.link import Link
from agents.plugins import files, registry
from agents.plugins.calls import Watched, wrong
from agents.plugins.law import Control, Law, Memory, RobotFacts, Said, View
from agents.plugins.laws import Gradient
from agents.plugins.registry import PluginError
from agents.plugins.triggers import Trigger, TriggerView
from agents.vectors import Vector
from experiments.cores import ONE_THREAD
from experiments.course.cells import Inmate

LONGEST: Final = 1 << 20  # longest answer [bytes]
LEARNED: Final = "policy"  # name of the law and of the trigger that compute a model
PASSED: Final = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "ZENPARK_CACHE_DIR")  # variables of the environment
FAILED: Final = 1  # exit code where none is known
ENDED: Final = -signal.SIGXCPU  # exit code of a process that had no computing time left
# Class variables that are taken from a group's class, by its base, with their types
DECLARES: Final[Mapping[type, Mapping[str, Any]]] = {
    Law: {"SAYS": dict[str, Said], "ALONE": bool, "PREDICTION": str},
    Trigger: {
        "MEMORY": dict[str, float], "PREDICTION": str, "TIMED": bool, "JUDGES_ERRORS": bool, "JUDGES_DRIFT": bool,
    },
}  # fmt: skip


class CellProcess(NamedTuple):
    """Process of a cell, as its questioner knows it."""

    connection: Connection
    number: int  # id of its process


class Company:
    """Cells of a flight: one for each robot, and plug-in of the group."""

    def __init__(self, control: socket.socket, cpu_s: int, memory: int) -> None:
        self._control, self._limits = control, (cpu_s, memory)
        self._cells: dict[tuple[int, object], tuple[CellProcess, object]] = {}  # key: id of the plug-in, robot
        self._codes: dict[int, int] = {}  # exit codes by the numbers of processes
        self.processes: list[int] = []  # numbers of all cells that there were
        self.flies = False  # a flight that counts: laws of links have a cell for each link then

    def ask(self, plugin: Any, robot: object, method: str, *arguments: object) -> Any:  # noqa: ANN401 - of any kind
        """Answer of the plug-in of a robot: numbers, texts, lists and dictionaries; raises PluginError."""
        if any(isinstance(each, Watched) for each in arguments):
            raise TypeError("what is watched stays in its process")
        key = id(plugin), robot
        if key not in self._cells:
            given = {name: getattr(plugin, name) for name in plugin.__struct_fields__}
            self._cells[key] = self._begun(type(plugin), _changed(type(plugin), given)), plugin
            self._result(self._cells[key][0])
        cell, _ = self._cells[key]
        with suppress(OSError):  # it has ended, as its missing answer says
            cell.connection.send_bytes(pickle.dumps((method, arguments)))
        return self._result(cell)

    def _begun(self, stand_in: Any, parameters: Mapping[str, Any] | None) -> CellProcess:  # noqa: ANN401 - a class
        """A new cell for a stand-in."""
        near, far = socket.socketpair()
        socket.send_fds(self._control, [b"cell"], [far.fileno()])
        far.close()
        number = int(self._control.recv(64) or FAILED)
        self.processes.append(number)
        cell = CellProcess(Connection(near.detach()), number)
        inmate = Inmate(stand_in.GROUP, stand_in.CHOICE, parameters, [*DECLARES[stand_in.BASE]], *self._limits)
        cell.connection.send_bytes(pickle.dumps(tuple(inmate)))
        return cell

    def declared(self, stand_in: Any) -> dict[str, Any]:  # noqa: ANN401 - a class
        """Class variables of the group's class; raises PluginError."""
        cell = self._begun(stand_in, None)
        answer = self._result(cell)
        cell.connection.close()
        wanted = DECLARES[stand_in.BASE]
        try:
            return {name: msgspec.convert(answer[name], kind) for name, kind in wanted.items()}
        except (msgspec.ValidationError, TypeError, KeyError) as error:
            raise PluginError(f"{files.plain(stand_in.CHOICE)} declares what cannot be used: {error}") from None

    def leave(self) -> None:
        """End the cells: those of the flight that follows know nothing of what was before."""
        self.flies = True
        for cell, _ in self._cells.values():
            cell.connection.close()
        self._cells.clear()

    def _result(self, cell: CellProcess) -> Any:  # noqa: ANN401 - of any kind
        try:
            said = msgspec.msgpack.decode(cell.connection.recv_bytes(LONGEST))
        except (EOFError, ConnectionError):
            raise PluginError(self._end_of(cell.number)) from None
        except (OSError, msgspec.DecodeError):
            raise PluginError("its process answers what is none") from None
        if isinstance(said, str):
            raise PluginError(said)
        if not (isinstance(said, list) and len(said) == 1):
            raise PluginError("its process answers what is none")
        return said[0]

    def _end_of(self, number: int) -> str:
        if number not in self._codes:
            self._control.send(b"%d" % number)
            self._codes[number] = int(self._control.recv(64) or FAILED)
        code = self._codes[number]
        if code == ENDED:
            return f"took more than {self._limits[0]} s of computing time"
        return f"its process ended, {f'by signal {-code}' if code < 0 else f'with exit code {code}'}"


@contextmanager
def company(
    choices: Sequence[str], solved: Path, handed: Path, cpu_s: int, memory: int, *, learned: bool = False
) -> Iterator[Company]:
    """Puts stand-ins in the places of the classes of a course; they are gone with the block, as is the process.

    Args:
        choices: Classes in files that groups write, `law.py:Meet`.
        solved: Folder of these files as the course has them.
        handed: Folder of these files as the group has them.
        cpu_s: Computing time of a cell [s].
        memory: Memory of a cell [bytes].
        learned: Also puts them in the places of the law and the trigger that compute a model in the ONNX format.
    """
    near, far = socket.socketpair()
    command = [sys.executable, "-P", "-m", "experiments.course.cells", str(far.fileno()), "numpy"]
    command += ["onnxruntime"] * learned
    command += sorted({name for each in choices for name in _imports(handed / each.partition(":")[0])})
    kept = {name: os.environ[name] for name in PASSED if name in os.environ}
    environment = {**kept, **dict.fromkeys(ONE_THREAD, "1"), "PYTHONDONTWRITEBYTECODE": "1"}
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        command, pass_fds=[far.fileno()], env=environment, cwd="/", stdin=quiet, stdout=quiet, stderr=quiet
    ) as nursery:
        far.close()
        made, places = Company(near, cpu_s, memory), list[type]()
        try:
            for choice in choices:
                places.append(_stand_in(choice, solved, handed, made))
            for group in (registry.LAWS, registry.TRIGGERS) if learned else ():
                places.append(_replace(registry.load(group, LEARNED), LEARNED, made))
            yield made
        finally:
            for solution in places:
                setattr(sys.modules[solution.__module__], solution.__name__, solution)
            made.leave()
            near.close()
            nursery.kill()


def _stand_in(choice: str, solved: Path, handed: Path, asked: Company) -> type:
    """Put a stand-in into the place of a class of the course, which is returned; raises PluginError."""
    adopted, _ = files.adopt(choice, solved)
    copy, _ = files.adopt(choice, handed)
    return _replace(files.load(adopted), copy, asked)


def _replace(solution: type, copy: str, asked: Company) -> type:
    """The same of a class, which cells know as `copy`."""
    base = next((each for each in DECLARES if issubclass(solution, each)), None)
    if base is None:
        raise PluginError(f"{solution.__name__} is neither a law nor a trigger: groups can write these alone")
    group = registry.LAWS if base is Law else registry.TRIGGERS
    content: dict[str, Any] = {"GROUP": group, "CHOICE": copy, "BASE": base, "COMPANY": asked}
    content |= {name: getattr(solution, name) for name in ("__module__", "__qualname__", "__doc__")}
    content |= _TRIGGER if base is Trigger else _GRADIENT if issubclass(solution, Gradient) else _LAW
    make: Any = partial(type(solution), solution.__name__, (solution,))
    content |= asked.declared(make(content, frozen=True))
    setattr(sys.modules[solution.__module__], solution.__name__, make(content, frozen=True))
    return solution


def _begin(self: Any, robot: RobotFacts) -> Any:  # noqa: ANN401 - a stand-in, and whatever a group answers
    return self.COMPANY.ask(self, robot.name, "begin", robot)


def _step(self: Any, view: View, memory: Memory) -> Control:  # noqa: ANN401 - likewise
    said = self.COMPANY.ask(self, view.robot.name, "step", view, memory)
    if not (isinstance(said, dict) and isinstance(said.get("memory"), dict) and isinstance(said.get("measures"), dict)):
        raise wrong("law", self, "step", said, "a Control")
    fields: dict[str, Any] = {name: said.get(name) for name in Control.__struct_fields__}
    return Control(**fields)


def _pull(self: Any, apart: Vector, link: Link) -> Vector:  # noqa: ANN401 - likewise
    company = self.COMPANY
    answer = company.ask(self, link if company.flies else "", "pull", apart, link)
    try:
        pulled: Vector = msgspec.convert(answer, Vector)
    except msgspec.ValidationError:
        raise wrong("law", self, "pull", answer, "three numbers") from None
    return pulled


def _fires(self: Any, view: TriggerView) -> bool:  # noqa: ANN401 - likewise
    fired, memory = self.COMPANY.ask(self, view, "fires", view)
    if not isinstance(fired, bool):
        raise wrong("trigger", self, "fires", fired, "True or False")
    numbers = {name: memory[name] for name in self.MEMORY if isinstance(memory.get(name), float | int)}
    vars(view.memory).update(numbers)
    return fired


def _analyse(self: Any, plan: Any) -> tuple[()]:  # noqa: ANN401 - likewise
    """Nothing: the analysis of a law would compute here."""
    return ()


_LAW: Final = {"begin": _begin, "step": _step, "analyse": _analyse}
_GRADIENT: Final = {"pull": _pull}
_TRIGGER: Final = {"fires": _fires}


def _changed(stand_in: Any, given: Mapping[str, Any]) -> dict[str, Any]:  # noqa: ANN401 - a class
    """Parameters that are not the solution's defaults: a group may write others into its class."""
    fields = fields_of(stand_in)
    return {name: value for name, value in given.items() if value != fields[name].default}


def _imports(file: Path) -> set[str]:
    """Names of the modules that a Python file imports, without those of Python; none of one that is not Python."""
    try:
        nodes = [*ast.walk(ast.parse(file.read_text("utf-8")))]
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError):
        return set()
    names = {each.name for node in nodes if isinstance(node, ast.Import) for each in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    return {name for name in names if re.fullmatch(r"\w+(\.\w+)*", name) and name.partition(".")[0] not in SKIPPED}


SKIPPED: Final = sys.stdlib_module_names | {"zenpark"}
