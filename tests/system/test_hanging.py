"""Robots whose loop hangs, or whose whole process is frozen, come down, and do not act on what they knew before."""

import os
import re
import signal
import time

import pytest
import zenoh

from agents.network import messages, pubsub
from agents.network import session as network
from tests.commands import ROOT
from tests.system.lab import ENVIRONMENT, Flight, RobotProcess, Watcher, WorldProcess

pytestmark = pytest.mark.system

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
        self._truths = pubsub.subscriber(self.session, self.keys.truth("*"), 4096)
        self.place = {}
        self.heights = []  # of any robot: when [s, UTC] and how high [m] it was

    def look(self):
        super().look()
        for sample in network.received(self._truths.handler):
            truth = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Position)
            self.place[truth.robot] = truth
            self.heights.append((truth.stamp, truth.position[2]))

    def height(self, robot):
        return self.place[robot].position[2] if robot in self.place else 0.0


@pytest.fixture
def watcher(router):
    with Truth(router.endpoint) as made:
        yield made


def lonely(folder, trigger=""):
    """One Tello in a world."""
    lonely_file = folder / "lonely.toml"
    lonely_file.write_text(
        f'title = "lonely"\nduration_s = 60.0\n{trigger}\n[arena]\nsize = [2.0, 2.0, 2.0]\n'
        '[robots.TE01]\nkind = "tello"\nbody = "world"\nstart = [0.0, 0.0]\nhover = 0.6\n'
    )
    return lonely_file


@pytest.fixture
def lonely_file(tmp_path):
    return lonely(tmp_path)


@pytest.mark.mechanism("watchdog: control loop hangs")
def test_a_loop_that_hangs_is_landed_and_said(router, watcher, tmp_path, monkeypatch):
    (tmp_path / "hangs.py").write_text(HANGS)
    about = tmp_path / "hangs-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hangs\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[zenpark.triggers]\nhangs = hangs:Hangs\n")
    flag = tmp_path / "now"
    lonely_file = lonely(tmp_path, f'trigger = {{ kind = "hangs", file = "{flag}" }}')
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
    lonely_file = tmp_path / "short.toml"
    lonely_file.write_text(
        'title = "short"\nduration_s = 1.5\ntrigger = { kind = "periodic" }\n'
        '[robots.TE01]\nkind = "tello"\nstart = [0.0, 0.0]\nhover = 0.6\n'
        '[robots.KH01]\nkind = "khepera4"\nstart = [0.5, 0.5]\n'
    )
    flight = Flight(tmp_path / "out", lonely_file, report=True)
    try:
        flight.until_said("phase conductor: landing")
        flight.children()["TE01"].suspend()
        code, _ = flight.finish(90.0)
    finally:
        flight.signal(signal.SIGKILL)
    assert code == 1
    assert re.search(r"lost TE01: did not end its landing within 15 s: \w+", flight.said())
    assert "zenpark: Failed in default: TE01 at " in flight.said()
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    verdict = report[report.index("In short") :]
    assert verdict.index("TE01 at") < verdict.index("No pose was lost")
