"""Wrong inputs: each is refused with its place and a remedy, exit code 2, without a traceback, and soon."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer.main

from agents.body.interface import BodyEntry, shared_devices
from agents.plugins import registry
from bridges.khepera4.kind import KHEPERA4
from experiments.check.safety import libraries
from experiments.definition.plan import Plan
from experiments.file.document import loads
from tests.cases import mostly_slow
from tools.main import app, main
from twins.body import TwinBody

TWINS = ", ".join(name.removesuffix("-twin") for name in registry.names(registry.DEVICES))
TRIANGLE = (Path(__file__).parents[2] / "experiments" / "catalogue" / "triangle.toml").read_text("utf-8")
RADIO = 'body = "radio://0/80/2M/E7E7E7E701"\n'
START = "start = [-0.6, -0.5]"

# a part of the triangle, what stands there instead; place and remedy that are told
FILES = (
    ('kind = "khepera4" ', 'kind = "kephera" ', ":13:8: no 'kephera' among the kinds", "did you mean 'khepera4'?"),
    (START, "start = [-6.6, -0.5]", ":14:10: 'KH01' starts outside of the arena", "x lies between -1 and 1"),
    ('"send-on-delta", threshold', '"relative-control", floor', "decides when the law is recomputed", "[formation]"),
    ("position_sigma = 0.0003", "hover_jitter = 0.02", "must be a table", "write hover_jitter = { sigma"),
    (START, START + "\n" + RADIO, "'radio' drives a crazyflie, and KH01 is a khepera4", "kteam, khepera4-twin"),
    ("hover = 0.6", 'hover = 0.6\nbody = "radoi://0"', ":24:8: no 'radoi' among the bodies", "did you mean 'radio'?"),
)

GROUPS = ("cameras", "lab", "turtlebot")
SIMPLE = ("clean", "list", "runs", "station")  # commands with no more than switches
RUN = "run triangle.toml --virtual --no-report"
COMMANDS = (
    (f"{RUN} --set cases.event.trigger.treshold=1", "trigger.treshold=1: ", "did you mean 'threshold'?"),
    (f"{RUN} --set trigger.threshold", "--set trigger.threshold: ", "write, for example, --set formation.gain=2.5"),
    (f"{RUN} --set cases.evnt.seed=1", "the file has no case 'evnt'", "did you mean 'event'?"),
    (f"{RUN} --set robots.KH09.hover=1", "no robot is called 'KH09'", "did you mean 'KH02'?"),
    (f"{RUN} --set robots.KH01.hover=1", "'KH01' is a khepera4, which does not fly", "leave hover out"),
    (f"{RUN} --set rates.body_hz=1e9", "--set rates.body_hz=1e9: ", "must be a number <= 2000"),
    (f"{RUN} --set duration_s=0.001", "--set duration_s=0.001: ", "give it 0.02 s or more"),
    (f"{RUN} --seeds 0", "--seeds: ", "must be greater than or equal to 1"),
    (f"{RUN} --seeds 99999", "--seeds: ", "take fewer --seeds"),
    (f"{RUN} --case evnt", "no case 'evnt' in this experiment", "did you mean 'event'?"),
    (f"{RUN} --out full", "full: holds something already", "name a new folder with --out"),
    (f"{RUN} --out triangle.toml", "triangle.toml: is a file", "name a new folder with --out"),
    (f"{RUN} --tag a,b", "--tag: ", "a tag is a word without commas"),
    ("run triangle.toml --seeds 3", "--seeds: only for --virtual", "in real time, run once per --seed"),
    ("run triangle.toml --pace 2", "--pace: only for --virtual --view", "add both, or leave it out"),
    ("run triangle --virtual --view --seeds 3", "--seeds: one run is viewed", "leave out --view or --seeds"),
    ("run triangle.toml --lab nope", "nope is no lab", "`./zenpark lab init"),
    ("run trianlge", "trianlge: neither a file nor an experiment", "did you mean 'triangle'?"),
    ("run nope.zip", "nope.zip: is no bundle", "`./zenpark export RUN --bundle`"),
    ("run triangle.toml --vitual", "No such option: --vitual", "--virtual"),
    ("run", "Missing argument 'FILE'", "for example: ./zenpark run "),
    ("rum", "No such command 'rum'", "Did you mean 'run'?"),
    ("start", "No such command 'start'.\n", "`./zenpark --help` shows what there is"),
    ("chek triangle.toml", "No such command 'chek'. Did you mean 'check'?", "--help` shows what there is"),
    ("check -", "-: neither a file nor", "/dev/stdin is the standard input"),
    ("check full", "full: is a folder", "name a file in it: triangle.toml"),
    ("check empty.toml", "empty.toml: is empty", "./zenpark new copies an experiment"),
    ("check utf16.toml", "utf16.toml: is text in UTF-16", "save it as UTF-8"),
    ("check triangle.toml --plot x.doc", "--plot: x.doc", "must end in .svg, .pdf or .png"),
    ("check page.html", "page.html: is a page, no experiment", "such as experiment.toml"),
    ("explain disturbance.hover", "'disturbance.hover'", "did you mean 'disturbance.hover_jitter'?"),
    ("new triangle triangle.toml", "triangle.toml: exists already", "choose another name"),
    ("new mine.toml", "say what mine.toml begins with", "`./zenpark new triangle mine.toml`"),
    ("new --grid 5", "--grid 5: ", "such as 5x8"),
    ("new --grid 1000000x1000000", "robots are more than 5000", "give fewer"),
    ("new triangle nope/x.toml", "nope/x.toml: cannot be written", "choose a place that exists"),
    ("report nope", "nope: is no folder of a run", "`./zenpark run` prints the folder"),
    ("report full", "full: holds no recording", "name the folder of a run"),
    ("export nope.mcap", "nope.mcap: cannot be read", "give the .mcap file of a run"),
    ("sweep triangle.toml trigger.threshold=lim3", "at lim3: 'threshold' must be a number", "[m]"),
    ("import nope.yaml", "nope.yaml: there is no such file", "name an experiment file"),
    ("hosts check triangle.toml", "the experiment has no hosts", "[hosts.lab1]"),
    ("agent triangle.toml KH09", "no robot 'KH09' in this experiment", "did you mean 'KH02'?"),
    ("robot stop *", "NAME...: '*' cannot be a name", "use letters, digits and _"),
    ("estop KH01", "unexpected extra argument(s) (KH01)", "NOTHING WAS STOPPED"),
    ("STOP", "No such command 'STOP'", "NOTHING WAS STOPPED"),
    ("estop --realm *", "--realm: '*' cannot be a name", "use letters, digits and _"),
    ("agent join ../x", "NAME...: '../x' cannot be a name", "use letters, digits and _"),
    ("centre triangle.toml", "every robot of this experiment decides for itself", 'architecture = "centralised"'),
    ("world serve triangle.toml", "no robot of this experiment lives in a world", '`body = "world"`'),
    ("router --listen tcp/0.0.0.0:7447", "will not listen on tcp/0.0.0.0:7447", "`./zenpark lab init LAB FILE`"),
    ("router --listen nope", "'nope' is not an endpoint", "write it like tcp/127.0.0.1:7447"),
    ("twin nope", "there is no such protocol twin", f"known: {TWINS}"),
    ("export nope", "nope: is no folder of a run", "`./zenpark run` prints the folder"),
    ("install --editable ../mine", "by the script ./zenpark", "in its folder: ./zenpark install --editable ../mine"),
    ("view nope", "nope: holds no recording (.mcap)", "name the folder of a run"),
    ("echo park/** --seconds soon", "--seconds: must be a valid number", "`./zenpark echo --help`"),
    ("view", "no run is listed in", "name its router (--connect)"),
    ("keys --connect tcp/127.0.0.1:9", "no router answers at tcp/127.0.0.1:9", "--connect names another"),
    ("echo park//x", "'park//x' is not a key expression", "Write it like park/*/pose"),
    ("keys --connect @nope", "nope: cannot be read", "network.txt"),
    ("sweep triangle.toml seeds=5:1", "seeds=5:1: 5:1 goes down", "write seeds=1:5"),
    ("preflight nope.toml", "nope.toml: neither a file nor an experiment", "known: aggregative, "),
    ("course triangle.toml", "triangle.toml: cannot be written", "name another folder"),
    ("mark --seed -1 full", "--seed: must be greater than or equal to 0", "`./zenpark mark --help`"),
    ("top --realm *", "--realm: '*' cannot be a name", "use letters, digits and _"),
    ("bridge nope", "'nope' is none of cameras, optitrack", "`./zenpark bridge --help`"),
    ("docs x", "by the script ./zenpark", "in its folder: ./zenpark docs x"),
    ("hardware x", "by the script ./zenpark", "in its folder: ./zenpark hardware x"),
    ("test x", "by the script ./zenpark", "in its folder: ./zenpark test x"),
    *((f"{name} nope", "No such command 'nope'", f"`./zenpark {name} --help`") for name in GROUPS),
    *((f"{name} --nope", "No such option: --nope", f"`./zenpark {name} --help`") for name in SIMPLE),
)


@pytest.fixture
def refuse(tmp_path, monkeypatch, capfd):
    """A call of a command that is refused, which returns what is printed; in a folder with some files."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    for name in ("triangle.toml", "full/triangle.toml"):
        (tmp_path / name).write_text(TRIANGLE, "utf-8")
    (tmp_path / "empty.toml").touch()
    (tmp_path / "page.html").write_text("\n<!DOCTYPE html>\n")
    (tmp_path / "utf16.toml").write_text(TRIANGLE, "utf-16")

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["zenpark", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capfd.readouterr()
        assert ended.value.code == 2, printed
        assert "Traceback" not in printed.err
        return printed.err

    return call


@pytest.mark.parametrize(("part", "instead", "told", "remedy"), FILES, ids=[row[1][:30] for row in FILES])
def test_a_file_is_refused(part, instead, told, remedy, refuse):
    assert part in TRIANGLE
    Path("triangle.toml").write_text(TRIANGLE.replace(part, instead, 1), "utf-8")
    said = refuse("check", "triangle.toml")
    assert said.startswith("zenpark: triangle.toml:")
    assert told in said
    assert remedy in said


def test_every_command_has_a_row():
    missing = {*typer.main.get_command(app).commands} - {row[0].partition(" ")[0] for row in COMMANDS}
    assert not missing, "COMMANDS above has no wrong input of these"


@pytest.mark.parametrize(("command", "told", "remedy"), mostly_slow(COMMANDS, 3), ids=[row[0] for row in COMMANDS])
def test_a_command_is_refused(command, told, remedy, refuse):
    said = refuse(*command.split())
    assert told in said
    assert remedy in said


def test_a_missing_library_is_a_finding(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    experiment = loads(TRIANGLE.replace("hover = 0.6", "hover = 0.6\n" + RADIO)).experiment
    (claim,) = libraries(SimpleNamespace(plan=Plan(experiment)))
    assert claim.message == "the body 'radio' of CF01 needs cflib, which is not installed here"
    assert claim.remedy == "`./zenpark hardware` adds it"


@pytest.mark.parametrize(("second", "same"), [("ROVER://192.0.2.7:5005/", True), ("rover://192.0.2.7:5006", False)])
def test_two_robots_with_one_devices_address_are_found(second, same):
    def found(host):
        rows = [("RV01", "rover://192.0.2.7:5005", ""), ("RV02", "world", ""), ("RV03", second, host)]
        entries = [
            BodyEntry(name, KHEPERA4, body, {}, external=False, process=name, host=at) for name, body, at in rows
        ]
        return [
            (each.severity, each.robot, each.key, each.message)
            for each in shared_devices((each, TwinBody) for each in entries)
        ]

    message = f"RV01 has the same body, {second}, there rover://192.0.2.7:5005: one device gets the setpoints of both"
    assert found("") == ([("error", "RV03", ("body",), message)] if same else [])
    assert found("lab") == []
