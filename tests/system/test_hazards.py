"""Hazards of real processes: robots notice them, hang, are stopped; all come down, and the run says why."""

import os
import re
import signal
import time

import pytest
import zenoh

from agents.network import messages, pubsub
from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts import run_registry
from tests.commands import ROOT
from tests.system.lab import ENVIRONMENT, Flight, RobotProcess, Watcher, WorldProcess, typed
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


def test_drone_with_low_battery_lands_and_others_continue(tmp_path):
    folder = tmp_path / "run"
    low = "safety.battery_low=0.985"  # it flies for 7 minutes on a charge
    flight = Flight(folder, "triangle", "--case", "event", low, "duration_s=8")
    flight.until_said(r"hazard CF01: land: its battery is low: 98% \(limit 98%\)")
    assert flight.finish()[0] == 1
    assert "zenpark: Failed in event: CF01 at " in flight.said()
    played = flight.read()
    trace = played.trace
    said = [pose.position[2] for pose in typed(folder / "event.mcap", "/CF01/pose") if pose.stamp > played.started]
    hover = trace.plan.experiment.robots["CF01"].hover
    assert said, "it has flown"
    assert min(said) > hover - 0.1  # nobody follows it to the floor
    ends = {event.source: event.text for event in trace.events if event.kind == "robot"}
    assert ends["CF01"] == "done: its battery is low"
    assert ends["KH01"] == "done: finished"


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


@pytest.mark.timeout(120)
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
    trace = flight.read("first").trace
    assert ("stop", "conductor") in {(event.kind, event.source) for event in trace.events}
    ends = {event.source: event.text for event in trace.events if event.kind == "robot" and "done" in event.text}
    assert ends["CF01"] == "done: emergency stop by operator: zenpark estop"


@pytest.mark.mechanism("emergency stop of a run")
@pytest.mark.timeout(120)
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


class Truth(Watcher):
    """Where the world has its robots as well."""

    def __init__(self, endpoint):
        super().__init__(endpoint)
        self._truths = pubsub.Inbox(pubsub.subscriber(self.session, self.keys.truth("*"), 4096), messages.Position)
        self.place = {}
        self.heights = []  # of any robot: when [s, UTC] and how high [m] it was

    def look(self):
        super().look()
        for truth in self._truths.read():
            self.place[truth.robot] = truth
            self.heights.append((truth.stamp, truth.position[2]))

    def height(self, robot):
        return self.place[robot].position[2] if robot in self.place else 0.0


@pytest.fixture
def watcher(router):
    with Truth(router.endpoint) as made:
        yield made


LONELY = """
title = "one Tello in a world"
duration_s = 60.0
arena.size = [2.0, 2.0, 2.0]
robots.TE01 = { kind = "tello", body = "world", start = [0.0, 0.0], hover = 0.6 }
"""


@pytest.fixture
def lonely_file(tmp_path):
    return written(tmp_path, LONELY)


@pytest.mark.mechanism("watchdog: control loop hangs")
def test_a_loop_that_hangs_is_landed_and_said(router, watcher, tmp_path, monkeypatch):
    (tmp_path / "hangs.py").write_text(HANGS)
    about = tmp_path / "hangs-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hangs\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[zenpark.triggers]\nhangs = hangs:Hangs\n")
    flag = tmp_path / "now"
    lonely_file = written(tmp_path, f'{LONELY}trigger = {{ kind = "hangs", file = "{flag}" }}')
    monkeypatch.setitem(ENVIRONMENT, "PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT)]))
    with (
        WorldProcess(router.endpoint, lonely_file) as world,
        RobotProcess(router.endpoint, lonely_file, "TE01") as robot,
    ):
        watcher.take_off("TE01")
        flag.touch()
        watcher.until(lambda: watcher.status["TE01"].reason.startswith("its control loop hangs"), "it is said")
        assert watcher.phase("TE01") == "landing"
        watcher.until(lambda: "TE01" not in watcher.alive, "nobody counts on it")
        watcher.until(lambda: watcher.height("TE01") < 0.02, "it is down")
        assert robot.process.poll() is None  # landed, not fallen
        robot.kill()
        world.kill()


def test_process_frozen_aloft_is_landed_and_notices(router, watcher, lonely_file):
    with WorldProcess(router.endpoint, lonely_file), RobotProcess(router.endpoint, lonely_file, "TE01") as robot:
        watcher.take_off("TE01")
        high, stopped = watcher.height("TE01"), time.time()
        robot.freeze()
        watcher.until(lambda: watcher.height("TE01") < 0.02, "the world lands it")
        held = [height for stamp, height in watcher.heights if stopped < stamp < stopped + 1.5]
        assert len(held) > 10
        assert min(held) > high - 0.1  # and holds it first
        again = messages.encode(messages.Order("takeoff"))
        asked = watcher.session.get(watcher.keys.order("TE01"), payload=again, timeout=0.1)
        assert not [reply for reply in asked if reply.ok is not None]
        robot.thaw()
        watcher.until(lambda: watcher.status["TE01"].reason == "it came down by itself", "it knows")
        assert watcher.height("TE01") < 0.02
        watcher.until_all("done", "TE01")


def test_frozen_process_leaves_body_to_its_replacement(router, watcher, lonely_file):
    with WorldProcess(router.endpoint, lonely_file), RobotProcess(router.endpoint, lonely_file, "TE01") as old:
        watcher.take_off("TE01")
        old.freeze()
        watcher.until(lambda: watcher.height("TE01") < 0.02, "the world lands it")
        watcher.until(lambda: "TE01" not in watcher.alive, "its lease is over")
        watcher.status.clear()
        with RobotProcess(router.endpoint, lonely_file, "TE01"):
            watcher.take_off("TE01")
            heights = [watcher.height("TE01")]
            old.thaw()

            def left():
                heights.append(watcher.height("TE01"))
                return old.process.poll() is not None

            watcher.until(left, "the old one leaves")
            assert old.process.returncode == 2
            assert "TE01: another process has taken this name" in old.said()
            assert min(heights) > heights[0] - 0.05
            assert watcher.phase("TE01") == "airborne"


def test_stop_behind_a_flood_of_deletions_is_obeyed(router, watcher, lonely_file):
    with WorldProcess(router.endpoint, lonely_file), RobotProcess(router.endpoint, lonely_file, "TE01"):
        watcher.take_off("TE01")
        for _ in range(2000):
            watcher.session.delete(watcher.keys.estop)
        said = messages.encode(messages.Stop("a test", "now"))
        block = zenoh.CongestionControl.BLOCK
        watcher.session.put(watcher.keys.estop, said, encoding=messages.JSON, congestion_control=block)
        watcher.until_all("done", "TE01")
        watcher.until(lambda: watcher.height("TE01") < 0.02, "it fell")
        assert watcher.status["TE01"].reason == "emergency stop by a test: now"


def test_process_hanging_in_final_landing_fails_the_run(tmp_path):
    robots = (
        'TE01 = { kind = "tello", start = [0.0, 0.0], hover = 0.6 }\nKH01 = { kind = "khepera4", start = [0.5, 0.5] }'
    )
    file = written(tmp_path, f'title = "short"\nduration_s = 1.5\ntrigger = "periodic"\n[robots]\n{robots}\n')
    flight = Flight(tmp_path / "out", file, report=True)
    try:
        flight.until_said("phase conductor: landing")
        flight.children()["TE01"].suspend()
        assert flight.finish(90.0)[0] == 1
    finally:
        flight.signal(signal.SIGKILL)
    assert re.search(r"lost TE01: did not end its landing within 15 s: \w+", flight.said())
    assert "zenpark: Failed in default: TE01 at " in flight.said()
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    verdict = report[report.index("In short") :]
    assert verdict.index("TE01 at") < verdict.index("No pose was lost")
