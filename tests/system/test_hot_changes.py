"""Robots that are adopted, hold, are removed, restarted, replaced and added while the others fly on."""

import json
import signal

import pytest

from agents.network import messages
from experiments.file import catalogue
from experiments.real_time.conductor import orders
from tests.commands import zenpark
from tests.system.lab import PATIENCE_S, TRIANGLE, Flight, RobotProcess, Watcher

pytestmark = pytest.mark.system

SPARES = """
[robots.KH03]
kind = "khepera4"
start = [-0.7, 0.7]
standby = true
[spares]
S1 = { kind = "crazyflie", start = [0.6, 0.3], hover = 0.6 }
S2 = { kind = "khepera4", start = [-0.6, -0.2] }

[formation]"""
LOW = ("robots.CF01.hover=0.3", "spares.S1.hover=0.3", "formation.gain=1.4")  # soon up, and down


class HotFlight(Flight):
    """The triangle with a robot on standby and two spares, in flight, and an operator."""

    def __init__(self, folder):
        file, text = folder / "x.toml", catalogue.path("triangle").read_text("utf-8")
        text = text.replace("[formation]", SPARES, 1)
        file.write_text(text.replace('"KH01 - KH02"', '"KH01 - KH03" = 0.60\n"KH01 - KH02"', 1))
        settings = ("duration_s=60", "rates.body_hz=50", *LOW)
        super().__init__(folder / "run", file, "--case", "event", "--json", *settings)
        self.until_flown()
        self.router = self.endpoint()
        self.watcher = Watcher(self.router)
        self.watcher.until_all("running", *TRIANGLE)

    def change(self, what, *names, **more):
        order = messages.RunOrder(what, list(names), **more)
        return orders.send_run_order(self.watcher.session, self.watcher.keys, order)

    def zenpark(self, *words, code=None):
        return zenpark("robot", *words, "--connect", self.router, code=code)

    def end(self):
        """Ctrl-C: all land."""
        self.process.send_signal(signal.SIGINT)
        assert self.finish()[0] in (0, 130)


@pytest.fixture
def hot(tmp_path):
    made = HotFlight(tmp_path)
    with made.watcher:
        yield made
    if made.process.returncode is None:
        made.end()


@pytest.mark.mechanism("hot change: hold, remove, add")
def test_robots_hold_leave_and_come_while_others_continue(hot):
    watcher, status = hot.watcher, hot.watcher.status
    assert hot.zenpark("hold", "CF01", code=0).stdout == "CF01: holds where it is\n"
    watcher.until(lambda: status["CF01"].reason == "ordered to hold", "its status says so")
    assert watcher.all("running", "KH01", "KH02", "CF01")
    assert hot.zenpark("resume").stdout.splitlines() == ["CF01: goes on", "KH01: goes on", "KH02: goes on"]
    watcher.until(lambda: status["CF01"].reason == "", "it goes on")

    before = status["KH02"].pid
    assert "removed" in hot.change("remove", "KH02").done["KH02"]
    watcher.until(lambda: "KH02" not in watcher.alive, "its process is over")
    watcher.until(lambda: "KH02" in status["CF01"].missing, "its neighbours know")
    assert (status["KH02"].phase, status["KH02"].reason) == ("done", "ordered to leave")
    assert watcher.all("running", "KH01", "CF01"), "the others go on"
    assert hot.zenpark("hold", "KH02").stderr.startswith("KH02: no: no answer\n")
    assert "takes part" in hot.change("add", "KH02").done["KH02"], "who was removed may come back"
    watcher.until(lambda: status["KH02"].pid != before and watcher.all("running", "KH02"), "it runs")
    assert "already" in hot.change("add", "KH02").refused["KH02"]

    assert set(hot.change("add", "KH03").done) == {"KH03"}, "who was on standby joins"
    watcher.until(lambda: watcher.all("running", "KH03") and not status["KH01"].missing, "it is a neighbour")
    hot.end()
    events = [(event.kind, event.source, event.text) for event in hot.read().trace.events]
    assert ("order", "operator", "hold: CF01") in events
    assert " lost " not in hot.said()


SHORT = ("--case", "event", "--json", "duration_s=2")


def file_with_board(folder, endpoint):
    file = folder / "x.toml"
    text = catalogue.path("triangle").read_text("utf-8")
    text += f'\n[network]\nconnect = ["{endpoint}"]\n[hosts.board]\nrobots = ["KH02"]\n'
    file.write_text(text)
    return str(file)


def test_present_robot_is_adopted_unless_it_has_flown(router, watcher, tmp_path):
    file = file_with_board(tmp_path, router.endpoint)
    with (
        RobotProcess(router.endpoint, "join", "KH02", "--once") as at_boot,
        RobotProcess(router.endpoint, "triangle", "CF01", "--case", "event") as by_hand,
    ):
        watcher.until(lambda: "CF01" in watcher.alive, "it is there")
        flight = Flight(tmp_path / "run", file, *SHORT)
        flight.until_said("adopted CF01(, KH02)?: is there already, idle")  # one line, if both are idle by then
        flight.until_said("adopted (CF01, )?KH02: is ")
        watcher.until_all("running", "KH02")
        assert at_boot.wait() == 0, "with --once it ends when it is down, so that its service starts it anew"
        watcher.until(lambda: watcher.status["KH02"].reason == "finished", "it knew what --set had changed")
        watcher.give(messages.Order("land"), "CF01")  # its own file has twenty seconds
        code, out = flight.finish()
        assert code == 0
        assert by_hand.process.poll() is None
        logs = sorted(file.stem for file in (tmp_path / "run" / "logs").glob("event-*"))
        assert logs == ["event-KH01", "event-recorder"]
        assert set(json.loads(out)["cases"]["event"]["robots"]) == {"KH01", "KH02", "CF01"}
        assert flight.read().complete

        again = Flight(tmp_path / "again", file, *SHORT)
        again.until_said("CF01: on the network already, and done; a robot that was started by hand flies once")
        assert again.finish()[0] == 2
        assert by_hand.end() == 0


def test_who_joined_lands_when_the_conductor_is_dead(router, watcher, tmp_path):
    with RobotProcess(router.endpoint, "join", "KH02", "--once") as joined:
        flight = Flight(tmp_path / "run", file_with_board(tmp_path, router.endpoint), "--case", "event")
        watcher.until_all("running", "KH02")
        flight.process.kill()
        flight.finish()
        assert joined.wait(PATIENCE_S) == 0
        watcher.look()
        assert (watcher.phase("KH02"), watcher.status["KH02"].reason) == ("done", "asked to end")
        watcher.until(lambda: not watcher.alive, "so do the others")
