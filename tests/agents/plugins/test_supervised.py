"""Plug-ins that end the process or never return: refused like any failure, with their line."""

import os
import signal
import time
from contextlib import suppress
from types import ModuleType

import pytest

from agents.plugins import files
from agents.plugins.calls import supervised
from agents.plugins.registry import PluginError
from experiments.definition.plan import Plan
from experiments.file.document import DocumentError, load
from experiments.virtual_time.simulation import simulate
from tests.commands import zenpark
from tests.small import pair

TASK = 'title = "Alone"\nduration_s = 2.0\n[robots]\nA = { kind = "khepera4", start = [0.0, 0.0] }\n'
LAW = """
import os
from zenpark import Control, Law

class Own(BaseException):
    pass

class Mine(Law):
    ALONE = True
    def step(self, view, memory):
        if view.time >= 0.5:
            {}
        return Control(memory=memory)
"""


@pytest.fixture
def task(tmp_path, monkeypatch):
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "task.toml").write_text(TASK + '[formation]\nlaw = "mine.py:Mine"\n', "utf-8")

    def written(statement, law=LAW):
        (tmp_path / "mine.py").write_text(law.format(statement), "utf-8")
        return tmp_path / "task.toml"

    return written


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("raise SystemExit(0)", r"the law Mine failed: SystemExit: 0 \(mine\.py:12\)"),
        ("raise GeneratorExit", r"the law Mine failed: GeneratorExit:  \(mine\.py:12\)"),
        ("os._exit(0)", r"the plug-in in mine\.py ends the process: os\._exit\(0\) \(mine\.py:12\)"),
    ],
)
def test_law_that_ends_the_process_is_refused(task, statement, said):
    plan = load(task(statement)).plan
    with pytest.raises(PluginError, match=said):
        simulate(plan, 1)
    assert os._exit.__module__ == "posix"


@pytest.mark.parametrize("statement", ["raise SystemExit(0)", "import os; os._exit(0)"])
def test_file_that_ends_the_process_is_refused(task, statement):
    with pytest.raises(DocumentError, match=r"task\.toml:6:7: plug-in 'mine\.py:Mine' cannot be loaded: .*1"):
        load(task(statement, law="{}"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statement", "command"), [("raise SystemExit(0)", "check"), ("raise Own", "run"), ("os._exit(0)", "check")]
)
def test_command_fails_with_the_line(task, statement, command):
    done = zenpark(command, task(statement), *(["--virtual"] if command == "run" else []), "--json", code=2)
    assert "mine.py:12" in done.stdout
    assert '"ok": false' in done.stdout


def module_of(text):
    """Names that a module of a user's file defines."""
    made = ModuleType(f"{files.PREFIX}mine")
    exec(compile(text, "mine.py", "exec"), made.__dict__)
    return made


ENDLESS = "def step(ends):\n    while True:\n        pass\n"
DEAF = "from contextlib import suppress\ndef begin(ends):\n    while not ends():\n        pass\n"


def test_call_that_never_returns_is_interrupted():
    step = module_of(ENDLESS).step
    said = r"`step` of the plug-in in mine\.py took more than .* s \(mine\.py:[23]\)"
    with pytest.raises(PluginError, match=said), supervised(0.02):
        step(None)
    assert signal.getitimer(signal.ITIMER_REAL)[1] != pytest.approx(0.02)


def test_calls_that_return_are_left_alone():
    """Many short calls, and one that may load a library."""
    end = time.monotonic() + 0.1
    with supervised(0.02):
        while time.monotonic() < end:
            module_of("def step(): pass").step()
        begun = time.monotonic()
        module_of(DEAF).begin(lambda: time.monotonic() > begun + 0.1)


def test_clock_of_a_caller_goes_on():
    rung = []
    former = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    left, period = signal.setitimer(signal.ITIMER_REAL, 0.05)
    try:
        with supervised(), supervised():
            pass
        deadline = time.monotonic() + 5.0
        while not rung and time.monotonic() < deadline:
            with suppress(InterruptedError):
                time.sleep(0.01)
    finally:
        signal.signal(signal.SIGALRM, former)
        signal.setitimer(signal.ITIMER_REAL, left, period)
    assert rung == [1]


def test_laws_of_zenpark_are_not_in_the_way():
    assert len(simulate(Plan(pair(duration_s=1.0)), 1).time) > 10
