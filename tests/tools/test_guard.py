import os
import signal
import sys
import threading
from unittest.mock import Mock

import pytest
import typer

from agents.network import shutdown
from experiments.recording.version import DIGEST_CHARACTERS, digest, provenance
from tests.commands import ROOT, python, zenpark
from tools.guard import PACKAGES, intruders
from tools.main import call


def start(folder, *path):
    """The command line, started in a folder and with these first on the import path."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    return python("-c", "from tools.guard import main; main()", "--version", cwd=folder, env=environment, code=None)


def test_passes_when_the_packages_are_ours(tmp_path):
    assert intruders(ROOT) == {}
    assert intruders(tmp_path) == {name: ROOT / name for name in PACKAGES}
    done = start(tmp_path, ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{provenance().words[0]}\n", "")
    assert done.stdout.startswith(f"zenpark 0.1.0, code {digest()[:DIGEST_CHARACTERS]}")


def test_ctrl_c_while_it_starts_prints_no_traceback():
    def interrupted():
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        os.kill(os.getpid(), signal.SIGINT)

    done = zenpark("--version", code=130, preexec_fn=interrupted)
    assert (done.stdout, done.stderr) == ("", "")
    program = (
        "import runpy, sys\n"
        "class Interrupted:\n"
        "    def find_spec(name, *_):\n"
        "        if name == 'hashlib': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupted)\n"
        "runpy.run_path('zenpark', run_name='__main__')"
    )
    assert python("-c", program, code=130).stderr == ""


@pytest.mark.slow
def test_guard_names_obstructing_package_and_remedy(tmp_path):
    for name in ("agents", "twins"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('must not be imported')")
    (tmp_path / "elsewhere").mkdir()
    done = start(tmp_path / "elsewhere", tmp_path, ROOT)
    assert (done.returncode, done.stdout) == (2, "")
    _, agents, twins, remedy = done.stderr.splitlines()
    assert f"'agents' comes from {tmp_path / 'agents'}" in agents
    assert f"not from {ROOT / 'twins'}" in twins
    assert str(ROOT / "zenpark") in remedy


def test_imports_nothing_of_ours_and_nothing_heavy():
    loaded = set(python("-c", "import sys, tools.guard; print(*sys.modules)").stdout.split())
    assert "tools.guard" in loaded
    assert not loaded & {"agents", "bridges", "twins", "experiments", "tools.main", "typer", "numpy", "zenoh"}


@pytest.mark.slow
def test_run_needs_no_typer_on_its_hosts():
    robot = ("agent", "-", "KH01", "--clock-correction=-0.5", "--lifeline")
    for words, code, module in ((["station"], 0, "hosts.station"), (robot, 2, "processes.robot")):
        done = python("-X", "importtime", "-m", "tools.guard", *words, code=code)
        loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
        assert f"experiments.real_time.{module}" in loaded
        assert not loaded & {"typer", "pydantic", "tools.main"}


@pytest.mark.slow
def test_a_robot_loads_no_openssl():
    program = (
        "import atexit, runpy, sys; sys.argv = ['robot', '--help'];"
        "atexit.register(lambda: print('openssl:', sys.modules['_hashlib'], 'hashlib' in sys.modules));"
        "runpy.run_module('experiments.real_time.processes.robot', run_name='__main__', alter_sys=True)"
    )
    assert python("-c", program).stdout.endswith("openssl: None True\n")


def test_command_ends_beside_threads_of_the_network(monkeypatch):
    """The interpreter would end such a thread inside Zenoh, and the process by SIGABRT after all went well."""
    app, over = typer.Typer(), threading.Event()

    @app.command()
    def leaving() -> int:
        threading.Thread(target=over.wait, daemon=True).start()
        return 3

    monkeypatch.setattr(sys, "argv", ["zenpark"])
    ended = Mock(side_effect=SystemExit)
    monkeypatch.setattr(shutdown.os, "_exit", ended)
    with pytest.raises(SystemExit):
        call(app)
    over.set()
    ended.assert_called_once_with(3)
