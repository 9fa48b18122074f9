"""Hazards of real processes: robots notice them, hang, are stopped; all come down, and the run says why."""

import os
import re
from types import SimpleNamespace

import pytest
import zenoh

from agents.network import messages, pubsub
from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts import run_registry
from tests.commands import ROOT
from tests.system.lab import ENVIRONMENT, Flight, RobotProcess, WorldProcess
from tools.commands import orders as order_commands

pytestmark = pytest.mark.system

PAIR = """
title = "Two that want to be nearer than they may"
duration_s = 6.0
trigger = "periodic"
[robots]
A = { kind = "khepera4", start = [-0.3, 0.0] }
B = { kind = "khepera4", start = [0.3, 0.0] }
[formation]
links = { "A - B" = 0.3 }
[safety]
"""


@pytest.mark.mechanism("hazard: conductor lost")
def test_robots_without_conductor_end_if_file_says_so(router, watcher, tmp_path):
    token = pubsub.alive_token(watcher.session, watcher.keys.conductor)
    with RobotProcess(router.endpoint, written(tmp_path, PAIR + 'lost_conductor = "land"'), "A", "B"):
        watcher.take_off("A", "B")
        token.undeclare()
        watcher.until_all("done", "A", "B")
        status = watcher.status["A"]
        assert status.reason == "the conductor is gone"
        silent = re.fullmatch(r"land: the conductor is gone: for (\d+\.\d+) s.*", status.hazard)
        assert float(silent[1]) >= 2.0
        assert [incident.text for incident in status.incidents] == [status.hazard]


TWO_CASES = """
title = "two that stay together"
duration_s = 90.0
[robots]
CF01 = { kind = "crazyflie", start = [-0.3, 0.0], hover = 0.5 }
KH01 = { kind = "khepera4", start = [0.3, 0.0] }
[formation]
gain = 1.0
links = { "CF01 - KH01" = 0.8 }
[cases]
first.trigger = { kind = "periodic", period_s = 0.02 }
second.trigger = { kind = "send-on-delta", threshold = 0.01 }
"""


def written(folder, text):
    file = folder / "x.toml"
    file.write_text(text)
    return file


def test_every_run_of_the_machine_ends_with_reason(tmp_path, capsys):
    file = written(tmp_path, TWO_CASES)
    flight = Flight(tmp_path / "run", file)
    flight.until_flown()
    other = Flight(tmp_path / "other", file)
    other.until_flown()
    there = f"two that stay together, {flight.folder}"
    assert f"another run is up with robots of these names (CF01, KH01): {there}" in other.said()
    up = [[flight.endpoint()], [other.endpoint()]]
    assert [run.endpoints for run in run_registry.runs()] == up
    # without the default router: whoever else uses this machine has a run there
    assert order_commands.stop_all(order_commands.stops_of_all_runs(), dry_run=False, as_json=False) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"stopped: CF01, KH01 (two that stay together, {each.folder}, at {endpoint})"
        for each, (endpoint,) in zip((flight, other), up, strict=True)
    ]
    for each in (flight, other):
        each.until_said(r"stop conductor: emergency stop by operator: zenpark estop; the run ends here")
        assert each.finish()[0] == 1
        assert "zenpark: emergency stop by operator: zenpark estop" in each.said()
        assert "second: " not in each.said()
        assert [recording.name for recording in each.folder.glob("*.mcap")] == ["first.mcap"]
    assert run_registry.runs() == []
    events = [(event.kind, event.source, event.text) for event in flight.read("first").trace.events]
    assert ("stop", "conductor") in {(kind, source) for kind, source, _ in events}
    assert ("robot", "CF01", "done: emergency stop by operator: zenpark estop") in events


@pytest.mark.mechanism("emergency stop of a run")
def test_before_the_common_start_too(tmp_path):
    high = ("robots.CF01.hover=2.0", 'formation.links={"CF01 - KH01" = 2.2}')
    flight = Flight(tmp_path / "run", written(tmp_path, TWO_CASES), *high)
    flight.until_said(r"ready conductor: 2 robots", 60.0)
    # not by a process: on a busy machine its start takes as long as a climb, after which comes the common start
    stop = EmergencyStop([flight.endpoint()], "park", "operator")
    stop.send("person in arena")
    assert stop.failure is None
    assert (stop.seen, stop.moving) == ({"CF01", "KH01"}, set())
    code, out = flight.finish()
    assert code == 1
    assert "common start" not in flight.said()
    assert "emergency stop by operator: person in arena, before the common start" in out
    assert not (flight.folder / "second.mcap").exists()


HANGS = """
import threading
from pathlib import Path
from agents.plugins.triggers import Trigger

class Hangs(Trigger, frozen=True):
    file: str = ""
    def fires(self, view):
        if Path(self.file).exists():
            threading.Event().wait()
        return view.error > 1e9
"""


LONELY = """
title = "one Tello in a world"
duration_s = 60.0
arena.size = [2.0, 2.0, 2.0]
robots.TE01 = { kind = "tello", body = "world", start = [0.0, 0.0], hover = 0.6 }
"""


@pytest.fixture
def lonely(router, watcher, tmp_path):
    """A Tello in the air, in a world of its own; its process, and whatever watches it."""
    file = tmp_path / "x.toml"
    if not file.exists():
        written(tmp_path, LONELY)
    truths = watcher.every(watcher.keys.truth("TE01"), messages.Position)
    with WorldProcess(router.endpoint, file) as world, RobotProcess(router.endpoint, file, "TE01") as robot:
        watcher.take_off("TE01")

        def until_down():
            watcher.until(lambda: truths[-1].position[2] < 0.02, "it is down")

        yield SimpleNamespace(world=world, robot=robot, truths=truths, file=file, until_down=until_down)


@pytest.fixture
def hanging(tmp_path, monkeypatch):
    """File that makes the control loop hang."""
    flag, about = tmp_path / "now", tmp_path / "hangs-1.dist-info"
    (tmp_path / "hangs.py").write_text(HANGS)
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hangs\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[zenpark.triggers]\nhangs = hangs:Hangs\n")
    written(tmp_path, f'{LONELY}trigger = {{ kind = "hangs", file = "{flag}" }}')
    monkeypatch.setitem(ENVIRONMENT, "PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT)]))
    return flag


@pytest.mark.mechanism("watchdog: control loop hangs")
def test_a_loop_that_hangs_is_landed_and_said(hanging, lonely, watcher):
    hanging.touch()
    watcher.until(lambda: watcher.status["TE01"].reason.startswith("its control loop hangs"), "it is said")
    assert watcher.phase("TE01") == "landing"
    watcher.until(lambda: "TE01" not in watcher.alive, "nobody counts on it")
    lonely.until_down()
    assert lonely.robot.process.poll() is None  # landed, not fallen
    lonely.robot.kill()
    lonely.world.kill()


def test_stop_behind_a_flood_of_deletions_is_obeyed(lonely, watcher):
    for _ in range(2000):
        watcher.session.delete(watcher.keys.estop)
    said = messages.encode(messages.Stop("a test", "now"))
    block = zenoh.CongestionControl.BLOCK
    watcher.session.put(watcher.keys.estop, said, encoding=messages.JSON, congestion_control=block)
    watcher.until_all("done", "TE01")
    lonely.until_down()
    assert watcher.status["TE01"].reason == "emergency stop by a test: now"
