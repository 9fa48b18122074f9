import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from agents.network.endpoints import EndpointError
from tests.cases import mostly_slow
from tests.commands import ROOT, environment, invoke, python
from tools.main import app, main, part_for
from tools.options import PANELS

COMMANDS = sorted(typer.main.get_command(app).commands)


def test_every_command_has_help():
    for command in (*COMMANDS, "bridge ros2"):
        assert invoke(*command.split(), "--help").stdout.lower().startswith(f"usage: zenpark {command} ")


LOADED = """
import sys
sys.argv[0] = "zenpark"
from tools.guard import main
try:
    main()
finally:
    print(*sys.modules, file=sys.stderr)
"""


def loaded(*words, program=LOADED, cwd=ROOT, **more):
    """Output of a command, and the modules that it has imported when it ends."""
    done = python("-c", program, *words, cwd=cwd, env=environment(**more), code=None)
    return done.stdout, set(done.stderr.split())


@pytest.mark.parametrize(
    ("words", "said", "heavy"),
    mostly_slow(
        [
            ("--help", "Usage: zenpark ", "numpy zenoh matplotlib msgspec pymunk rich asyncio jinja2 mcap pydantic"),
            ("list --json", "{", "numpy matplotlib zenoh pydantic"),
            ("check --help", "Usage: zenpark check ", "numpy matplotlib zenoh pydantic"),
            ("runs", "no run is listed in ", "numpy matplotlib mcap"),
            ("estop --connect tcp/127.0.0.1:9 --json", "{", "numpy matplotlib mcap"),
        ],
        3,
    ),
)
def test_light_commands_import_no_libraries(words, said, heavy, tmp_path):
    out, modules = loaded(*words.split(), cwd=tmp_path)
    assert out.startswith(said)
    assert not set(heavy.split()) & modules


def test_help_shows_commands_with_their_whole_description():
    shown = typer.main.get_command(app).commands
    panels = [name for names in PANELS.values() for name in names.split()]
    visible = {name for name, command in shown.items() if not command.hidden}
    assert {*panels} == visible, "each command stands in a panel of the help: PANELS in tools/options.py"
    words = " ".join(invoke("--help").stdout.split())
    for name in panels:
        assert " ".join(f"{name} {shown[name].help.partition(chr(10))[0]}".split()) in words


def with_parameters(built, above=()):
    for name, command in built.commands.items():
        if hasattr(command, "commands"):
            yield from with_parameters(command, (*above, name))
        elif command.params:
            yield " ".join((*above, name))


def test_call_builds_only_its_own_commands_parameters():
    whole = typer.main.get_command(app)
    assert {"run", "robot stop", "lab init"} < set(with_parameters(whole))
    for words in (*([name] for name in COMMANDS), ["robot", "stop", "KH01"], [], ["--help"], ["rnu"], ["robot", "run"]):
        built = typer.main.get_command(part_for(words))
        assert set(with_parameters(built)) == {" ".join(words[:2]), *words[:1]} & set(with_parameters(whole))
        assert built.commands.keys() == whole.commands.keys()
    for word in ("--help", "robot"):
        assert CliRunner().invoke(part_for([word]), [word]).stdout == invoke(word, code=None).stdout


@pytest.mark.parametrize(
    ("arguments", "why"),
    [("run robotic-prk", "robotic-prk: neither a file nor an experiment"), ("run", "Missing argument 'FILE'.")],
)
def test_errors_are_json_where_it_is_asked_for(arguments, why, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["zenpark", *arguments.split(), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    printed = capsys.readouterr()
    said = json.loads(printed.out)
    assert (ended.value.code, said["ok"]) == (2, False)
    assert said["error"].startswith(why)
    assert printed.err.startswith(f"zenpark: {why}")


def test_results_are_json_where_it_is_asked_for(tmp_path, monkeypatch):
    def answer(*words):
        return json.loads(invoke(*words, "--json").stdout)

    assert answer("list")["experiments"][-1]["name"] == "triangle"
    assert answer("explain", "disturbance.hover_jitter")[0]["key"].startswith("disturbance.")
    lines = invoke("explain", "send-on-delta").stdout.splitlines()
    assert lines[:2] == ["trigger(send-on-delta)", "formation.update(send-on-delta) "]
    assert len([line for line in lines if ".threshold" in line]) == 1  # parameters of both places once
    monkeypatch.chdir(tmp_path)
    past = tmp_path / "runs" / "past"
    past.mkdir(parents=True)
    for name in ("experiment.toml", "default.mcap"):
        (past / name).touch()
    (past / "run.json").write_text('{"begun": 1.0}')
    cleaned = answer("clean", "--older", "0", "--recordings")
    assert cleaned == [{"folder": "runs/past", "parts": ["runs/past/default.mcap"], "removed": False}]
    assert answer("lab", "init", "lab", "KH01")["identities"]["KH01"]["role"] == "robot"
    assert list(answer("lab", "issue", "lab", "ana")["identities"]) == ["ana"]


def test_routers_come_from_environment_option_or_file(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENPARK_CONNECT", "tcp/127.0.0.1:9 udp")
    (tmp_path / "network.txt").write_text("file\n")
    for words, endpoint in (
        ([], "udp"), (["--connect", "option"], "option"), (["--connect", f"@{tmp_path / 'network.txt'}"], "file")
    ):  # fmt: skip
        wrong = invoke("keys", *words, code=None).exception
        assert isinstance(wrong, EndpointError)
        assert repr(endpoint) in str(wrong)
    assert "[env var: ZENPARK_CONNECT]" in invoke("robot", "hold", "--help").stdout


def test_a_configuration_for_zenohd_is_printed():
    words = ("router", "--print-config", "--listen")
    made = json.loads(invoke(*words, "tcp/127.0.0.1:7999", "--connect", "tcp/lab:1").stdout)
    assert made["listen"] == {"endpoints": ["tcp/127.0.0.1:7999"]}
    assert made["connect"]["endpoints"] == ["tcp/lab:1"]
    assert made["scouting"]["multicast"] == {"enabled": False}
    assert "will not listen" in str(invoke(*words, "tcp/0.0.0.0:1", code=None).exception)


COMPLETED = {
    "run tri": ["triangle"],
    "run robotic-park --case pe": ["periodic"],
    "run triangle --set robots.KH01.ki": ["robots.KH01.kind="],
    "run triangle --set trigger.thr": ["trigger.threshold="],
    "run triangle --set cases.event.rates.bo": ["cases.event.rates.body_hz="],
    "agent triangle CF": ["CF01"],
    "report runs/f": ["runs/first"],
    "new mix": ["mixed-reality"],
    "robot ho": ["hold"],
}
COMPLETING = """
import contextlib, os, sys
sys.argv[0] = "zenpark"
from tools.guard import main
for typed in sys.argv[1:]:
    os.environ["_TYPER_COMPLETE_ARGS"] = f"zenpark {typed}"
    with contextlib.suppress(SystemExit):
        main()
    print("\\f")
print(*sys.modules, file=sys.stderr)
"""


@pytest.mark.slow
def test_completion_is_right_and_light(tmp_path):
    (tmp_path / "runs" / "first").mkdir(parents=True)
    (tmp_path / "runs" / "first" / "run.json").write_text("{}")
    said, modules = loaded(*COMPLETED, program=COMPLETING, cwd=tmp_path, _ZENPARK_COMPLETE="complete_zsh")
    assert not {"numpy", "zenoh", "experiments.file.json_schema"} & modules
    answers = [re.findall(r'"([^"]+?)(?:":".*?)?"', each) for each in said.split("\f\n")[:-1]]
    assert dict(zip(COMPLETED, answers, strict=True)) == COMPLETED


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a device that is always full")
@pytest.mark.parametrize(("output", "code", "unbuffered"), [("> /dev/full", 2, ""), (">&-", 0, "1")])
def test_output_that_goes_nowhere_makes_no_traceback(output, code, unbuffered):
    words = ["sh", "-c", f'exec "$0" -m tools.guard explain rates {output}', sys.executable]
    given = {"cwd": ROOT, "env": environment(PYTHONUNBUFFERED=unbuffered), "timeout": 60, "text": True}
    done = subprocess.run(words, check=False, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, **given)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert ("cannot be written: No space left on device" in done.stderr) == (code == 2)
