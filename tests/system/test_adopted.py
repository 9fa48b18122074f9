"""Robots that were started by hand or at boot: a run takes them as they are, and starts only the others."""

import json
import shutil
import signal

import pytest

from agents.network import messages
from agents.network.endpoints import free_endpoint
from experiments.file import catalogue
from experiments.real_time.hosts import authority
from experiments.recording import playback
from tests.system.lab import PATIENCE_S, Flight, RobotProcess, Started

pytestmark = pytest.mark.system

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
        flight.until_said("adopted CF01: is there already, idle")
        flight.until_said("adopted KH02: is ")
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
        assert playback.read(tmp_path / "run" / "event.mcap").complete

        again = Flight(tmp_path / "again", file, *SHORT)
        again.until_said("CF01: on the network already, and done; a robot that was started by hand flies once")
        assert again.finish()[0] == 2
        assert by_hand.end() == 0


def test_lab_member_needs_only_its_own_files(tmp_path):
    lab, own = tmp_path / "lab", tmp_path / "robot" / "zenpark-lab"
    robots = dict.fromkeys(("KH01", "KH02", "CF01"), "robot")
    authority.create(lab, {**{role: role for role in authority.SERVICES}, **robots})
    own.mkdir(parents=True)
    for name in ("ca.pem", "KH02.pem", "KH02.key"):
        (lab / name).rename(own / name) if name.startswith("KH02") else shutil.copy(lab / name, own)
    endpoint = free_endpoint(preferred_port=0, protocol="tls")
    file = file_with_board(tmp_path, endpoint)
    reach = ("--connect", endpoint, "--lab", str(own))
    with (
        Started("tools.guard", "router", file, "--lab", str(lab), "--listen", endpoint) as router,
        Started("tools.guard", "agent", "join", "KH02", *reach, "--once") as joined,
    ):
        assert router.process.stdout.readline().startswith("router ready on tls/")
        flight = Flight(tmp_path / "run", file, "--lab", str(lab), *SHORT)
        flight.until_said("adopted KH02: is ")
        assert flight.finish()[0] == 0
        assert joined.wait() == 0
    trace = playback.read(tmp_path / "run" / "event.mcap").trace
    assert not trace.lost.any()


def test_who_joined_lands_when_the_conductor_is_dead(router, watcher, tmp_path):
    with RobotProcess(router.endpoint, "join", "KH02", "--once") as joined:
        flight = Flight(tmp_path / "run", file_with_board(tmp_path, router.endpoint), "--case", "event")
        watcher.until_all("running", "KH02")
        flight.signal(signal.SIGKILL)
        flight.finish()
        assert joined.wait(PATIENCE_S) == 0
        watcher.look()
        assert (watcher.phase("KH02"), watcher.status["KH02"].reason) == ("done", "asked to end")
        watcher.until(lambda: not watcher.alive, "so do the others")
