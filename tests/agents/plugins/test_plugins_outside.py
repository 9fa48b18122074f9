"""The plug-ins of docs/plugins.md, installed from outside of this repository."""

import json
import os
import re
import shlex
import socket
import threading
import tomllib
from contextlib import closing
from dataclasses import replace
from math import isnan, nan
from types import SimpleNamespace

import pytest

from agents.body.device_address import plain_device
from agents.body.device_locks import Claims
from agents.body.interface import BodyError, refuse
from agents.formation.link import Link
from agents.plugins import registry
from agents.ticks import Ticks
from agents.vectors import ZERO
from bridges.khepera4.kind import KHEPERA4
from experiments.definition.plan import Plan
from tests.agents.bench import Bench, near, own
from tests.agents.plugins.test_triggers import Play, standing
from tests.commands import ROOT, environment, python, shell
from tests.requests import request
from tests.small import triangle
from tests.waiting import until
from twins.device import DeviceRequest, Faults, serve_until_next
from twins.engines.point_mass import model

GUIDE = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
# `my_laws.py`, registered as `spring = "my_laws:Spring"` under `[project.entry-points."zenpark.laws"]`
REGISTERED = [
    # a reader's own body may have the name of the guide's
    (f"guide-{name}" if group in (registry.BODIES, registry.DEVICES) else name, *rest, group)
    for name, *rest, group in re.findall(
        r'`([\w-]+) = "(\w+):(\w+)"`\s+under\s+`\[project\.entry-points\."(zenpark\.\w+)"\]`', GUIDE, re.DOTALL
    )
]


def source_of(name):
    starts = (f"class {name}", f"\n{name} = ", f"def {name}(")
    (source,) = [block for block in BLOCKS if any(start in block for start in starts)]
    return source


def made_in_guide(name):
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
    written = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    written.mkdir()
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in made.items()) for group, made in groups.items()]
    (written / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture(scope="module")
def shelled(installed):
    with shell(installed) as command:
        yield command


@pytest.mark.slow
def test_trigger_of_the_docs_runs_from_outside(shelled):
    groups = {group for *_, group in REGISTERED} | {registry.LAWS}
    assert groups == {registry.BODIES, registry.DEVICES, *registry.CHOSEN}
    assert len(source_of("SendEvery").splitlines()) <= 20
    listed = shelled("list").stdout
    assert not [name for name, _, _, group in REGISTERED if group != registry.BODIES and name not in listed]
    assert re.search(r"Laws: .*\bspring\b", listed)
    choice = 'cases.event.trigger={ kind = "send-every", metres = 0.02, maximum_silence_s = 5.0 }'
    run = shelled("run", "triangle", "--virtual", "--json", "--no-report", "--set", "duration_s=5", "--set", choice)
    assert run.returncode == 0, run.stderr
    cases = json.loads(run.stdout)["cases"]
    assert 0.0 < cases["event"]["mean"]["f_hz"] < 0.1 * cases["periodic"]["mean"]["f_hz"]


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
    if group not in (registry.ENGINES, registry.DEVICES):
        registry.load(group, name)
assert registry.struct("zenpark.laws", "spring").__module__ == "my_laws"
assert "numpy" not in sys.modules
assert {{each for each in sys.modules if each.startswith("experiments")}} == {{"experiments", "experiments.api"}}
"""
    path = os.pathsep.join([str(installed), str(ROOT)])
    python("-c", program, cwd=installed, env=environment(PYTHONPATH=path))


@pytest.mark.slow
def test_kind_of_the_docs_is_known_everywhere(shelled, tmp_path):
    assert re.search(r"Kinds of robots: .*\bhovercraft\b", shelled("list").stdout)
    assert "0.8 kg" in shelled("explain", "hovercraft").stdout
    assert '"hovercraft"' in shelled("explain", "--schema").stdout
    words = ["triangle", "--set", "robots.KH01.kind=hovercraft", "--set", "duration_s=4"]
    assert shelled("check", *words).returncode == 0
    refused = shelled("check", *words, "--set", "world.engine=pymunk")
    assert "'hovercraft' does not move in this engine" in refused.stderr + refused.stdout
    run = shelled("run", *words, "--virtual", "--no-report", "--out", str(tmp_path / "run"))
    assert run.returncode == 0, run.stderr
    # where it is not installed, but a broken one, which spoils neither the help nor experiments without it
    other = tmp_path / "other"
    other.mkdir()
    install(other, "broken", "1", {"zenpark.kinds": {"wreck": "wrecks:WRECK"}})
    (other / "wrecks.py").write_text("raise LookupError('on purpose')\n")
    with shell(other) as command:
        listed, unknown = command("list"), command("check", *words)
        wreck = command("check", "triangle", "--set", "robots.KH01.kind=wreck")
        fine = [command(*each) for each in (["report", str(tmp_path / "run")], ["--help"], ["check", "triangle"])]
    assert "hovercraft" not in listed.stdout
    assert re.search(r"left out: .*wreck.*on purpose", listed.stderr)
    assert [each.returncode for each in (listed, *fine)] == [0] * 4
    assert "no 'hovercraft' among the kinds of robots" in unknown.stderr + unknown.stdout
    assert "the kind 'wreck' cannot be used" in wreck.stderr + wreck.stdout


class Rover(threading.Thread):
    """Robot of the guide at the other end of its link: each twist lasts 0.02 s."""

    def __init__(self):
        super().__init__()
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.bind(("127.0.0.1", 0))
        self.place = self.link.getsockname()
        self.x, self.twists, self.lost, self.answers = 0.0, [], False, 0

    def run(self):
        while True:
            payload, sender = self.link.recvfrom(1500)
            if not payload:
                return
            twist = json.loads(payload)
            self.twists.append((twist["v"], twist["w"]))
            self.x += 0.02 * twist["v"]
            self.link.sendto(b"not a pose", sender)
            self.link.sendto(json.dumps({"x": nan if self.lost else self.x, "y": 0.0, "yaw": 0.0}).encode(), sender)
            self.answers += 1


@pytest.fixture
def rover():
    robot = Rover()
    robot.start()
    yield robot
    robot.link.sendto(b"", robot.place)
    robot.join()
    robot.link.close()


def rovers(*addresses):
    return made_in_guide("Rovers")(request(["khepera4"] * len(addresses), addresses))


def test_body_of_the_docs_drives_over_udp(rover):
    body = rovers("rover://{}:{}".format(*rover.place))
    body.open()
    for _ in range(3):
        body.command([(0.5, 0.0, 0.0, 0.0)])
    until(lambda: body.read(7.0)[0].position[0] > 0.0299)
    (state,) = body.read(7.0)
    assert (state.position, state.time) == (pytest.approx((0.03, 0.0, 0.0)), 7.0)
    rover.lost, answers = True, rover.answers
    body.stop([0])
    body.command([(0.5, 0.0, 0.0, 0.0)])
    until(lambda: rover.answers == answers + 2)
    state.velocity = (0.0, 0.0, 0.0)  # as the loop does
    (state,) = body.read(8.0)
    assert all(map(isnan, state.velocity))
    assert (state.time, state.received) == (7.0, 8.0)  # poses that are no numbers are none: it becomes blind
    assert rover.twists[-5:] == [(0.5, 0.0)] * 3 + [(0.0, 0.0)] * 2
    body.close()


@pytest.mark.slow
def test_body_of_the_docs_refuses_wrong_addresses():
    with pytest.raises(BodyError, match=r"R0: 'rover://nowhere' is no rover; write rover://192"):
        refuse(made_in_guide("Rovers"), request("khepera4", "rover://nowhere"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        with pytest.raises(BodyError, match="no pose within 3 s"):
            rovers("rover://{}:{}".format(*silent.getsockname())).open()


def test_twin_of_the_docs_answers_its_body():
    twin = made_in_guide("RoverTwin")(DeviceRequest(request(["khepera4"] * 2, "rover-twin"), Faults()))
    over, ticks = threading.Event(), Ticks(100.0)

    def serve():
        while not over.is_set():
            twin.advance(serve_until_next(twin, ticks))
        twin.close()

    thread = threading.Thread(target=serve)
    thread.start()
    body = rovers(*twin.addresses)
    try:
        body.open()
        assert [state.position for state in body.read(1.0)] == [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
        until(lambda: body.command([(0.1, 0.0, 0.0, 0.0)] * 2) or body.read(2.0)[1].position[0] > 0.02)
        assert body.read(3.0)[1].position[1:] == (1.0, 0.0)
    finally:
        over.set()
        thread.join()
        body.close()


def test_twin_of_the_docs_stops_without_commands():
    twin = made_in_guide("RoverTwin")(DeviceRequest(request("khepera4", "rover-twin"), Faults()))
    (wire,) = twin.sockets()
    with closing(twin), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b'{"v": 0.1, "w": 0.0}', wire.getsockname())
        twin.serve(wire, 0.0)
        for tick in range(1, 501):
            twin.advance(0.01 * tick)
    assert 0.03 < twin.truth()[0][0, 0] < 0.06


def test_devices_of_the_docs_have_one_driver(runtime_folder):
    numbered, calibrate = made_in_guide("NumberedRovers"), made_in_guide("calibrate")
    named = [
        numbered.device_of(SimpleNamespace(name="A", address=f"rover://{rest}"))
        for rest in ("localhost/80/3", "127.0.0.1/80/3", "localhost/80/4")
    ]
    first, second, other = ({key for key, own in each.lock_keys() if own} for each in named)
    assert first & second
    assert not first & other
    with pytest.raises(BodyError, match="write rover://base1/80/3"):
        numbered.device_of(SimpleNamespace(name="A", address="rover://base1"))
    claims = Claims([("KH01", plain_device("rover://127.0.0.1:5005"))])
    claims.take()
    with pytest.raises(BodyError, match="is in use: this process drives it for KH01"):
        calibrate("rover://localhost:5005", "localhost", "5005", lambda: 1.0)
    claims.release()
    assert calibrate("rover://localhost:5005", "localhost", "5005", lambda: 1.0) == 1.0


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


def test_law_kind_and_trigger_of_the_docs():
    law, link = made_in_guide("Spring")(constant=0.3), Link(0.5)
    assert law.pull((1.0, 0.0, 0.0), link) == pytest.approx((-0.15, 0.0, 0.0))
    assert law.error((1.0, 0.0, 0.0), link) == pytest.approx(0.5)
    assert law.pull((0.0, 0.0, 0.0), link) == (0.0, 0.0, 0.0)
    robot = model(made_in_guide("BARROW"), (0.0, 0.0, 0.0), 0.0)  # a kind without a class
    robot.command((0.3, 0.0, 0.0, 0.0))
    for _ in range(50):
        robot.move(0.02)
    assert 0.1 < robot.position[0] <= 0.3
    trigger = made_in_guide("Fading")(threshold=0.0, floor=0.01, forget=0.1)  # it spends what it saved
    saved, spent = (Play(trigger, standing(ticks) + standing(1, (0.015, 0.0, 0.0))) for ticks in (100, 1))
    assert (saved.fired[-1], spent.fired[-1]) == (False, True)


def test_predictor_planner_and_avoidance_of_the_docs():
    sent = SimpleNamespace(position=(1.0, 2.0, 0.0), velocity=(0.2, 0.0, 0.0))
    assert made_in_guide("Cautious")(share=0.5).position(sent, 2.0) == pytest.approx((1.2, 2.0, 0.0))
    assert made_in_guide("Cautious")().velocity(sent, 9.0) == pytest.approx((0.1, 0.0, 0.0))
    shuttle = made_in_guide("Shuttle")(length=0.4, period_s=4.0)
    for t in (3.0, 5.0):
        assert shuttle.target(t, (1.0, 0.0, 0.0), 0.0)[:3] == pytest.approx((1.3, 0.0, 0.0))
    avoidance, goal, here = made_in_guide("StopShort")(), (0.5, 0.5, 0.5), own(KHEPERA4, (0.0, 0.0))
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.19, 0.0)), 0.01) == (0.0, 0.0, 0.5)
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.21, 0.0)), 0.01) == goal
