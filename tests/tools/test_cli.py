import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from agents.network.endpoints import EndpointError, free_endpoint
from agents.plugins import registry
from experiments.recording.version import DIGEST_CHARACTERS, digest, provenance
from tools.main import app, main, part_for
from tools.options import PANELS

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = sorted(typer.main.get_command(app).commands)


def zenpark(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "tools.guard", *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_commands():
    words = """
    agent bridge centre check clean docs echo estop explain export hardware hosts hz import install keys lab
    list new preflight recover replay report robot router run runs schema station sweep test top turtlebot
    twin view world
    """
    assert words.split() == COMMANDS


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    said = CliRunner().invoke(app, [command, "--help"])
    assert said.exit_code == 0
    assert said.stdout.startswith(f"Usage: zenpark {command} ")


LOADED = """
import sys
sys.argv[0] = "zenpark"
from tools.guard import main
try:
    main()
finally:
    print(*sys.modules, file=sys.stderr)
"""


def loaded(*words, program=LOADED, cwd=ROOT, **environment):
    """Output of a command, and the modules that it has imported when it ends."""
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout, set(done.stderr.split())


HEAVY = {"numpy", "matplotlib", "zenoh", "pydantic"}


@pytest.mark.parametrize(
    "words", [["--help"], ["list"], ["list", "--json"], ["check", "--help"], ["explain", "--help"]]
)
def test_light_commands_import_no_libraries(words):
    said, modules = loaded(*words)
    assert said
    assert not HEAVY & modules


def test_texts_need_no_pydantic(tmp_path):
    said, modules = loaded("hosts", "check", str(tmp_path / "none.toml"), "--lab", "lab", "--json")
    assert "none.toml" in json.loads(said)["error"]
    assert "pydantic" not in modules


def test_help_shows_commands_with_their_whole_description():
    shown = typer.main.get_command(app).commands
    panels = [name for names in PANELS.values() for name in names.split()]
    assert sorted(panels) == sorted(name for name, command in shown.items() if not command.hidden)
    said = CliRunner().invoke(app, ["--help"]).stdout
    assert [line for line in said.splitlines()[1:] if "..." in line or len(line) > 80] == []
    assert [line[:-1] for line in said.splitlines() if line[:-1] in PANELS] == list(PANELS)
    words = " ".join(said.split())
    for name in panels:
        assert " ".join(f"{name} {shown[name].help.partition(chr(10))[0]}".split()) in words


def with_parameters(built, above=()):
    """Commands that have parameters, by their words."""
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
    assert CliRunner().invoke(part_for(["--help"]), ["--help"]).stdout == CliRunner().invoke(app, ["--help"]).stdout
    assert CliRunner().invoke(part_for(["robot"]), ["robot"]).stdout == CliRunner().invoke(app, ["robot"]).stdout


def test_what_the_launcher_does_is_named():
    done = zenpark("install", "--editable", "../mine")
    assert (done.returncode, done.stdout) == (2, "")
    assert "./zenpark install --editable ../mine" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["run", "robotic-prk", "--json"], "robotic-prk: neither a file nor an experiment"),
        (["run", "--json"], "Missing argument 'FILE'."),
        (["report", "/nowhere", "--json"], "/nowhere: "),
        (["keys", "--connect", "localhost", "--json"], "'localhost' is not an endpoint"),
    ],
)
def test_errors_are_json_where_it_is_asked_for(arguments, why, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["zenpark", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    printed = capsys.readouterr()
    said = json.loads(printed.out)
    assert (ended.value.code, said["ok"]) == (2, False)
    assert said["error"].startswith(why)
    assert printed.err.startswith(f"zenpark: {why}")


def test_plugin_of_two_places_has_parameters_once():
    lines = CliRunner().invoke(app, ["explain", "send-on-delta"]).stdout.splitlines()
    assert lines[:2] == ["trigger(send-on-delta)", "formation.update(send-on-delta) "]
    (threshold,) = [line for line in lines if ".threshold" in line]
    assert (
        threshold
        == "trigger(send-on-delta).threshold δ: deviation of the held position that is allowed [m] [> 0, default: 0.01]"
    )


def test_tables_are_json_where_it_is_asked_for():
    said = CliRunner().invoke(app, ["list", "--json"])
    assert "event" not in json.loads(said.stdout)
    assert {"name": "triangle"}.items() <= {**json.loads(said.stdout)["experiments"][-1]}.items()
    said = CliRunner().invoke(app, ["explain", "disturbance.hover_jitter", "--json"])
    assert json.loads(said.stdout)[0]["key"].startswith("disturbance.")


def test_results_of_actions_are_json_on_request(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    past = tmp_path / "runs" / "past"
    past.mkdir(parents=True)
    for name in ("experiment.toml", "default.mcap"):
        (past / name).touch()
    (past / "run.json").write_text('{"begun": 1.0}')
    invoke = CliRunner().invoke
    said = json.loads(invoke(app, ["clean", "--older", "0", "--recordings", "--json"]).stdout)
    assert said == [{"folder": "runs/past", "parts": ["runs/past/default.mcap"], "removed": False}]
    made = json.loads(invoke(app, ["lab", "init", "lab", "KH01", "--json"]).stdout)
    assert made["identities"]["KH01"]["role"] == "robot"
    assert list(json.loads(invoke(app, ["lab", "issue", "lab", "ana", "--json"]).stdout)["identities"]) == ["ana"]


def test_routers_come_from_the_environment(monkeypatch):
    monkeypatch.setenv("ZENPARK_CONNECT", "tcp/127.0.0.1:9 udp")
    found = CliRunner().invoke(app, ["keys"]).exception
    assert isinstance(found, EndpointError)
    assert "'udp'" in str(found)
    assert "'tcp'" in str(CliRunner().invoke(app, ["keys", "--connect", "tcp"]).exception)
    assert "[env var: ZENPARK_CONNECT]" in CliRunner().invoke(app, ["robot", "hold", "--help"]).stdout


def test_help_is_light():
    said, modules = loaded("--help")
    assert said.startswith("Usage: zenpark ")
    heavy = {"numpy", "zenoh", "matplotlib", "msgspec", "pymunk", "rich", "asyncio", "jinja2", "mcap", "pydantic"}
    assert not heavy & modules


def test_an_emergency_stop_waits_for_no_numpy():
    _, modules = loaded("estop", "--connect", "tcp/127.0.0.1:9")
    assert "tools.commands.orders" in modules
    assert not {"numpy", "matplotlib", "mcap"} & modules
    said, modules = loaded("runs")
    assert said == "no run is up on this machine\n"
    assert not {"numpy", "matplotlib", "mcap"} & modules


@pytest.mark.slow
def test_version():
    done = zenpark("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{provenance().words[0]}\n", "")
    assert done.stdout.startswith(f"zenpark 0.1.0, code {digest()[:DIGEST_CHARACTERS]}")


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "robotic-park", "--seed", "-1"],
        ["run", "robotic-park", "--seeds", "0"],
        ["run", "robotic-park", "--fly"],
        ["run"],
        ["agent", "robotic-park"],
        ["echo", "park/**", "-n", "0"],
        ["hz", "park/**", "--seconds", "soon"],
        ["fly"],
    ],
)
def test_bad_flags_end_with_2(arguments):
    said = CliRunner().invoke(app, arguments)
    assert said.exit_code == 2
    assert "Error: " in said.stderr


@pytest.mark.parametrize("bridge", ["vicon", "ros2"])
def test_each_bridge_explains_its_options(bridge):
    said = CliRunner().invoke(app, ["bridge", bridge, "--help"])
    assert said.exit_code == 0
    assert said.stdout.startswith(f"usage: zenpark bridge {bridge} ")


@pytest.mark.parametrize("command", [["keys"], ["echo", "park/**"], ["hz", "park/**"]])
@pytest.mark.slow
def test_no_router_is_explained(command):
    endpoint = free_endpoint(preferred_port=0)
    done = zenpark(*command, "--connect", endpoint)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        f"zenpark: no router answers at {endpoint}: `./zenpark router` starts one, --connect names another; "
        "in a lab it needs --lab\n"
    )


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["router", "--listen", "tcp/0.0.0.0:7447"], "will not listen on tcp/0.0.0.0:7447"),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                (["echo", "park//pose"], "'park//pose' is not a key expression"),
                (["keys", "--connect", "localhost"], "'localhost' is not an endpoint"),
            )
        ),
    ],
)
def test_bad_input_is_explained(arguments, why):
    done = zenpark(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"zenpark: {why}")
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_configuration_for_zenohd_is_printed():
    done = zenpark("router", "--print-config", "--listen", "tcp/127.0.0.1:7999", "--connect", "tcp/lab:1")
    assert done.returncode == 0
    made = json.loads(done.stdout)
    assert made["listen"] == {"endpoints": ["tcp/127.0.0.1:7999"]}
    assert made["connect"]["endpoints"] == ["tcp/lab:1"]
    assert made["scouting"]["multicast"] == {"enabled": False}
    assert zenpark("router", "--print-config", "--listen", "tcp/0.0.0.0:1").returncode == 2


@pytest.mark.slow
def test_endpoints_come_from_the_file_of_a_run(tmp_path):
    file = tmp_path / "network.txt"
    endpoint = free_endpoint(0)
    file.write_text(f"{endpoint}\n")
    done = zenpark("keys", "--connect", f"@{file}")
    assert (done.returncode, endpoint in done.stderr) == (2, True)
    done = zenpark("keys", "--connect", "@nowhere")
    assert (done.returncode, done.stderr[:30]) == (2, "zenpark: nowhere: cannot be re")


COMPLETED = (
    ("run tri", ["triangle"]),
    ("run robotic-park --case pe", ["periodic"]),
    ("run triangle --set dur", ["duration_s="]),
    ("run triangle --set robots.KH01.ki", ["robots.KH01.kind="]),
    ("run triangle --set safety.sep", ["safety.separation="]),
    ("run triangle --set robots.CF01.ho", ["robots.CF01.hover="]),
    ("run triangle --set trigger.thr", ["trigger.threshold="]),
    ("run triangle --set cases.event.rates.bo", ["cases.event.rates.body_hz="]),
    ("run triangle --set formation.t", ["formation.tracking_gain="]),
    ("agent triangle CF", ["CF01"]),
    ("report runs/f", ["runs/first"]),
    ("new mix", ["mixed-reality"]),
    ("robot ho", ["hold"]),
)
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
    typed, offered = zip(*COMPLETED, strict=True)
    said, modules = loaded(*typed, program=COMPLETING, cwd=tmp_path, _ZENPARK_COMPLETE="complete_zsh")
    assert not {"numpy", "zenoh", "experiments.file.json_schema"} & modules
    answers = [re.findall(r'"([^"]+?)(?:":".*?)?"', each) for each in said.split("\f\n")[:-1]]
    assert dict(zip(typed, answers, strict=True)) == dict(zip(typed, offered, strict=True))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(("output", "code"), [("> /dev/full", 2), (">&-", 0)])
def test_output_that_goes_nowhere_makes_no_traceback(output, code, unbuffered):
    """A full disk is named; an output that the caller closed is none."""
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" -m tools.guard explain rates {output}', sys.executable],
        cwd=ROOT, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    )  # fmt: skip
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert ("cannot be written: No space left on device" in done.stderr) == (code == 2)


def test_unknown_twin_names_every_protocol_twin():
    known = registry.names(registry.DEVICES)
    shown = CliRunner().invoke(app, ["twin", "boat"])
    assert known
    assert all(name.removesuffix("-twin") in str(shown.exception) for name in known)
