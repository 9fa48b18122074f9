"""The plug-ins of docs/plugins.md, installed from outside of this repository."""

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tomllib
from dataclasses import replace
from math import hypot, isnan, nan
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyError
from agents.formation.link import Link
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins import registry
from agents.vectors import ZERO
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.signals import Play, standing
from tests.agents.things import near, own
from tests.commands import ROOT, environment, python, shell
from tests.requests import request
from tests.small import triangle
from tests.system import lab
from tests.waiting import until
from twins.engines.point_mass import model

GUIDE = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
# `my_laws.py`, registered as `spring = "my_laws:Spring"` under `[project.entry-points."zenpark.laws"]`
REGISTERED = re.findall(
    r'`([\w-]+) = "(\w+):(\w+)"`\s+under\s+`\[project\.entry-points\."(zenpark\.\w+)"\]`', GUIDE, re.DOTALL
)


def source_of(name):
    (source,) = [block for block in BLOCKS if f"class {name}" in block or f"\n{name} = " in block]
    return source


def made_in_guide(name):
    """Object that the guide defines by this name."""
    names = {"__name__": "guide"}
    exec(source_of(name), names)
    return names[name]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The examples as an installer would leave them: their modules, and what their distribution registers."""
    folder = tmp_path_factory.mktemp("plugins")
    (project,) = [block for block in re.findall(r"```toml\n(.*?)```", GUIDE, re.DOTALL) if "my-plugins" in block]
    about = tomllib.loads(project)["project"]
    groups = about["entry-points"]
    assert groups == {"zenpark.laws": {"spring": "my_laws:Spring"}}
    (folder / "my_laws.py").write_text(source_of("Spring"), encoding="utf-8")
    for name, module, made, group in REGISTERED:
        (folder / f"{module}.py").write_text(source_of(made), encoding="utf-8")
        groups.setdefault(group, {})[name] = f"{module}:{made}"
    install(folder, about["name"], about["version"], groups)
    return folder


def install(folder, name, version, groups):
    """Leaves in a folder what an installer leaves of a distribution with these entry points."""
    written = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    written.mkdir()
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in made.items()) for group, made in groups.items()]
    (written / "entry_points.txt").write_text("\n".join(lines))


def path_with(folder):
    return os.pathsep.join([str(folder), str(ROOT)])


@pytest.fixture(scope="module")
def shelled(installed):
    with shell(installed) as command:
        yield command


def test_every_group_has_an_example():
    assert {group for _, _, _, group in REGISTERED} | {registry.LAWS} == {registry.BODIES, *registry.CHOSEN}


@pytest.mark.slow
def test_trigger_of_the_docs_runs_from_outside(shelled):
    assert len(source_of("SendEvery").splitlines()) <= 20
    listed = shelled("list").stdout
    assert re.search(r"Triggers: .*\bsend-every\b", listed)
    assert re.search(r"Laws: .*\bspring\b", listed)
    assert not [name for name, _, _, group in REGISTERED if group != "zenpark.bodies" and name not in listed]
    choice = 'cases.event.trigger={ kind = "send-every", metres = 0.02, maximum_silence_s = 5.0 }'
    run = shelled("run", "triangle", "--virtual", "--json", "--no-report", "--set", "duration_s=5", "--set", choice)
    assert run.returncode == 0, run.stderr
    cases = json.loads(run.stdout)["cases"]
    assert 0.0 < cases["event"]["mean"]["f_hz"] < 0.1 * cases["periodic"]["mean"]["f_hz"]
    wrong = shelled("run", "triangle", "--virtual", "--set", choice.replace("metres", "meters"))
    assert wrong.returncode != 0
    assert "did you mean 'metres'?" in wrong.stderr


@pytest.mark.slow
@pytest.mark.parametrize("line", re.findall(r"^    \./zenpark (run triangle --virtual .*)$", GUIDE, re.MULTILINE))
def test_every_run_of_the_guide_ends_well(shelled, line, tmp_path):
    words = shlex.split(line)
    done = shelled(*words, "--case", "event", "--set", "duration_s=6", "--no-report", "--out", str(tmp_path / "run"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "metrics.csv").exists()


def test_robots_with_guide_plugins_need_no_numpy(installed):
    """Neither does one load anything of experiments but the names (tests/twins/test_body.py: a robot without them)."""
    program = f"""
import sys, agents.robot, twins.body
from agents.plugins import registry
registry.load("zenpark.laws", "spring")
for name, _, _, group in {REGISTERED}:
    if group != registry.ENGINES:
        registry.load(group, name)
assert registry.struct("zenpark.laws", "spring").__module__ == "my_laws"
assert "numpy" not in sys.modules
assert {{each for each in sys.modules if each.startswith("experiments")}} == {{"experiments", "experiments.api"}}
"""
    python("-c", program, cwd=installed, env=environment(PYTHONPATH=path_with(installed)))


@pytest.mark.slow
def test_kind_of_the_docs_is_known_everywhere(shelled, tmp_path):
    assert re.search(r"Kinds of robots: .*\bhovercraft\b", shelled("list").stdout)
    assert "0.8 kg" in shelled("explain", "hovercraft").stdout
    assert '"hovercraft"' in shelled("schema").stdout
    words = ["triangle", "--set", "robots.KH01.kind=hovercraft", "--set", "duration_s=4"]
    assert shelled("check", *words).returncode == 0
    refused = shelled("check", *words, "--set", "world.engine=pymunk")
    assert "'hovercraft' does not move in this engine" in refused.stderr + refused.stdout
    run = shelled("run", *words, "--virtual", "--no-report", "--out", str(tmp_path / "run"))
    assert run.returncode == 0, run.stderr
    (tmp_path / "none").mkdir()
    with shell(tmp_path / "none") as uninstalled:
        assert "hovercraft" not in uninstalled("list").stdout
        unknown = uninstalled("check", *words)
        report = uninstalled("report", str(tmp_path / "run"))
        assert report.returncode == 0, report.stderr
    assert "no 'hovercraft' among the kinds of robots" in unknown.stderr + unknown.stdout


def test_kind_of_the_docs_without_a_class_moves():
    robot = model(made_in_guide("BARROW"), (0.0, 0.0, 0.0), 0.0)
    robot.command((0.3, 0.0, 0.0, 0.0))
    for _ in range(50):
        robot.move(0.02)
    assert 0.1 < robot.position[0] <= 0.3


@pytest.mark.slow
def test_broken_kind_is_left_out(tmp_path):
    """A broken plug-in spoils neither the help nor experiments without it."""
    install(tmp_path, "broken", "1", {"zenpark.kinds": {"wreck": "wrecks:WRECK"}})
    (tmp_path / "wrecks.py").write_text("raise LookupError('on purpose')\n")
    with shell(tmp_path) as shelled:
        assert shelled("--help").returncode == 0
        listed = shelled("list")
        assert listed.returncode == 0
        assert re.search(r"left out: .*wreck.*on purpose", listed.stderr)
        assert shelled("check", "triangle").returncode == 0
        refused = shelled("check", "triangle", "--set", "robots.KH01.kind=wreck")
    assert "the kind 'wreck' cannot be used" in refused.stderr + refused.stdout


ROVER = """
import json, math, signal, socket, sys
x, y, yaw = float(sys.argv[1]), float(sys.argv[2]), 0.0
broken = []
signal.signal(signal.SIGUSR1, lambda *_: broken.append(True))
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", 0))
print(link.getsockname()[1], flush=True)
while True:
    payload, sender = link.recvfrom(1500)
    twist = json.loads(payload)
    print(twist["v"], twist["w"], file=sys.stderr, flush=True)
    yaw += 0.02 * twist["w"]
    x, y = x + 0.02 * twist["v"] * math.cos(yaw), y + 0.02 * twist["v"] * math.sin(yaw)
    link.sendto(b"not a pose", sender)
    link.sendto(json.dumps({"x": math.nan if broken else x, "y": y, "yaw": yaw}).encode(), sender)
"""
STARTS = {"RV01": (0.0, 0.0), "RV02": (0.6, 0.0), "RV03": (0.0, 0.6), "RV04": (0.6, 0.6)}
FAULTS = {"RV01": signal.SIGKILL, "RV02": signal.SIGSTOP, "RV03": signal.SIGUSR1}


@pytest.fixture
def four_rovers(tmp_path):
    """Robots of the guide as processes, and their addresses, by name; each writes its twists into a file."""
    processes = {}
    for name, start in STARTS.items():
        with (tmp_path / name).open("w") as twists:
            command = [sys.executable, "-c", ROVER, *map(str, start)]
            processes[name] = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=twists, text=True)
    yield {
        name: (process, f"rover://127.0.0.1:{int(process.stdout.readline())}") for name, process in processes.items()
    }
    for process in processes.values():
        process.kill()
        process.communicate()


def rovers(*addresses):
    return made_in_guide("Rovers")(request(["khepera4"] * len(addresses), addresses))


def test_body_of_the_docs_drives_over_udp(four_rovers, tmp_path):
    _, address = four_rovers["RV01"]
    body = rovers(address)
    body.open()
    for _ in range(3):
        body.command([(0.5, 0.0, 0.0, 0.0)])
    until(lambda: body.read(7.0)[0].position[0] > 0.0299)
    (state,) = body.read(7.0)
    assert state.position == pytest.approx((0.03, 0.0, 0.0))
    assert state.time == 7.0
    body.stop([0])
    body.command([(0.5, 0.0, 0.0, 0.0)])
    state.velocity = (0.0, 0.0, 0.0)  # as the loop does
    assert all(map(isnan, body.read(7.1)[0].velocity))
    driven = ["0.5 0.0"] * 3 + ["0.0 0.0"] * 2
    until(lambda: (tmp_path / "RV01").read_text().splitlines()[-5:] == driven)
    body.close()


@pytest.mark.system
def test_broken_robots_of_the_guide_fail_the_run(installed, four_rovers, tmp_path, monkeypatch):
    monkeypatch.setitem(lab.ENVIRONMENT, "PYTHONPATH", path_with(installed))
    robots = "".join(
        f'[robots.{name}]\nkind = "khepera4"\nstart = {list(STARTS[name])}\nbody = "{address}"\n'
        for name, (_, address) in four_rovers.items()
    )
    file = tmp_path / "rovers.toml"
    file.write_text(
        f'title = "Rovers"\nduration_s = 5.0\n[arena]\nsize = [4.0, 4.0, 2.0]\n{robots}'
        '[formation.links]\n"RV01 > RV04" = 0.6\n"RV02 > RV04" = 0.6\n'
    )
    flight = lab.Flight(tmp_path / "run", str(file), report=True)
    flight.until_said("event start|start conductor: common start")
    for name, fault in FAULTS.items():
        four_rovers[name][0].send_signal(fault)
    code, _ = flight.finish()
    assert code == 1
    said = flight.said()
    (failed,) = re.findall(r"^zenpark: (Failed in .*)$", said, re.MULTILINE)
    page = re.sub("<.*?>", "", (tmp_path / "run" / "report.html").read_text("utf-8"))
    top, *_ = re.split("No pose was lost|Samples were lost", page)
    for text in (failed, top):
        assert all(f"{name} at " in text for name in FAULTS)
    assert "RV04 at " not in failed
    assert "RV03: unresolved at the end: its own position is lost, for " in said
    assert "over: " not in said
    (recording,) = (tmp_path / "run").glob("*.mcap")
    drove = [state.velocity for state in lab.typed(recording, "/RV04/state")]
    assert max(hypot(*velocity[:2]) for velocity in drove if velocity) > 0.02  # the body measures none


@pytest.mark.slow
def test_body_of_the_docs_refuses_wrong_addresses():
    with pytest.raises(BodyError, match="no address"):
        rovers("rover://nowhere")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        with pytest.raises(BodyError, match="no pose within 3 s"):
            rovers("rover://{}:{}".format(*silent.getsockname())).open()


def test_law_of_the_docs_pulls_to_its_distance():
    law, link = made_in_guide("Spring")(constant=0.3), Link(0.5)
    assert law.pull((1.0, 0.0, 0.0), link) == pytest.approx((-0.15, 0.0, 0.0))
    assert law.error((1.0, 0.0, 0.0), link) == pytest.approx(0.5)
    assert law.pull((0.0, 0.0, 0.0), link) == (0.0, 0.0, 0.0)


def test_law_of_the_docs_with_memory_steps():
    law = made_in_guide("Mean")({"A": 3.0})
    bench = Bench(replace(Plan(triangle()).assignment("A"), law=law, start=None, starts=()), ZERO)

    def hear(bench):
        for link in range(2):
            said = {"x": (1.0,), "q": (0.0,)}
            bench.neighbours.receive(link, (0.5, 0.5 * link, 0.0), ZERO, bench.t, bench.t, yaw=nan, said=said)

    bench.running(hear).step(3.0, hear)
    assert 1.0 < bench.robot.stepping.memory["x"][0] < 3.0
    assert bench.robot.stepping.measures["disagreement"] > 0.0


def test_fading_of_the_docs_spends_what_it_saved():
    trigger = made_in_guide("Fading")(threshold=0.0, floor=0.01, forget=0.1)
    saved = Play(trigger, standing(100) + standing(1, (0.015, 0.0, 0.0)))
    assert not saved.fired[-1]
    assert Play(trigger, standing(1) + standing(1, (0.015, 0.0, 0.0))).fired[-1]


def test_predictor_and_planner_of_the_docs():
    sent = SimpleNamespace(position=(1.0, 2.0, 0.0), velocity=(0.2, 0.0, 0.0))
    assert made_in_guide("Cautious")(share=0.5).position(sent, 2.0) == pytest.approx((1.2, 2.0, 0.0))
    assert made_in_guide("Cautious")().velocity(sent, 9.0) == pytest.approx((0.1, 0.0, 0.0))
    shuttle = made_in_guide("Shuttle")(length=0.4, period_s=4.0)
    assert shuttle.target(3.0, (1.0, 0.0, 0.0), 0.0)[:3] == pytest.approx((1.3, 0.0, 0.0))
    assert shuttle.target(5.0, (1.0, 0.0, 0.0), 0.0)[:3] == pytest.approx((1.3, 0.0, 0.0))


def test_avoidance_of_the_docs_stops_short():
    avoidance, goal, here = made_in_guide("StopShort")(), (0.5, 0.5, 0.5), own(KHEPERA4, (0.0, 0.0))
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.19, 0.0)), 0.01) == (0.0, 0.0, 0.5)
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.21, 0.0)), 0.01) == goal
