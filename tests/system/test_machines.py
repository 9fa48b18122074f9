"""Experiments on several machines: network namespaces with a real sshd in each, also as a lab with mutual TLS."""

import itertools
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from experiments.file import catalogue
from experiments.real_time.hosts import authority
from experiments.real_time.hosts.hosts import ANSWER_S, DRIFT_S
from experiments.recording import playback
from experiments.recording.topics import CHUNK_BYTES
from tests.system.lab import NEAR_TRIANGLE, ROOT, TRIANGLE, options, typed, until
from tests.system.machines import machines, why_not
from tests.system.secured import new_lab
from tools.commands.run import SPOILED

pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(why_not()), reason=why_not() or "-")]

PARK = {"lab1": ["TB01", "KH01"], "lab2": ["KH02", "CF01"], "lab3": ["KH03", "CF02", "CF03"]}
EACH = {"lab1": ["KH01"], "lab2": ["KH02"], "lab3": ["CF01"]}  # enough for what does not depend on their number
TWO = {"lab1": ["KH01", "CF01"], "lab2": ["KH02"]}
CUT_S = 2.0
WRONG = {"offset_s": 0.2, "drift": 50e-6}  # clock of the second machine


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    with machines(tmp_path_factory.mktemp("machines"), ["desk", *PARK]) as made:
        yield made


class AtDesk:
    """An experiment with robots on the lab's machines, and the commands for it."""

    def __init__(self, lab, folder, hosts, *, name="triangle", case="event", keys=False, network="", **wrong):
        self.lab, self.file, self.out, self.case = lab, folder / "experiment.toml", folder / "run", case
        self.keys, self.there = folder / "lab", {host: folder / "there" / host for host in hosts}
        text = catalogue.path(name).read_text("utf-8")
        if keys:
            new_lab(self.keys)
            text += f'\n[network]\nlab = "lab"\n{network}\n'
        for host, robots in hosts.items():
            command = lab[host].zenpark_file(**wrong.get(host, wrong.get("all", {})))
            text += f'\n[hosts.{host}]\naddress = "{host}"\nzenpark = "{command}"\nrobots = {json.dumps(robots)}\n'
            text += f'lab = "{self.there[host]}"\n' if keys else ""
        self.file.write_text(text, "utf-8")

    def begin(self, command, *words):
        words = options("-m", "tools.guard", *command.split(), self.file, *words)
        streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        line = self.lab["desk"].command(sys.executable, *words)
        return subprocess.Popen(line, cwd=ROOT, env=self.lab.environment, text=True, **streams)

    def run(self, *words):
        return self.begin("run", "--case", self.case, "--out", self.out, "--anyway", *words)

    def end(self, process, code=0):
        """All that it said; no process is left on any machine."""
        out, _ = process.communicate(timeout=100)
        assert (0 if process.returncode == SPOILED else process.returncode) == code, out
        until(lambda: not self.busy(), "no process is left")
        return out

    def busy(self):
        return [process for each in self.lab.machines.values() for process in each.processes()]

    def said(self, robot):
        file = self.out / "logs" / f"{self.case}-{robot}.log"
        return file.read_text() if file.exists() else ""

    def until_running(self, *robots):
        for robot in robots:
            until(lambda robot=robot: f"{robot}: running" in self.said(robot), "it runs", 60.0)

    def read(self):
        return playback.read(self.out / f"{self.case}.mcap")

    def typed(self, topic):
        return typed(self.out / f"{self.case}.mcap", topic)

    def flies(self, duration_s=2.0):
        self.end(self.run(f"duration_s={duration_s}", "--no-report"))
        assert not self.read().trace.lost.any()
        for robot in TRIANGLE:
            assert f"{robot}: done (finished)" in self.said(robot)


def test_one_command_flies_reference_and_fetches_all_files(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, PARK, name="robotic-park", case="periodic", lab2=WRONG)
    out = desk.end(desk.run("--json", "duration_s=4", "timeline.0.at_s=1"))
    assert "lab2/CF01| CF01: running" in out, "output is streamed, with where it comes from"
    for robot in itertools.chain(*PARK.values()):
        states = [f"{robot}: running", f"{robot}: done (finished)"]
        assert re.findall(r".*(?:running|done.*)", desk.said(robot)) == states
    read = desk.read()
    assert read.complete
    assert not read.trace.lost.any()
    assert np.isfinite(read.trace.true_position).all(axis=(1, 2)).mean() > 0.99

    lies = {lie.host: lie for lie in read.trace.clocks}
    assert {host: list(lie.robots) for host, lie in lies.items()} == PARK
    for host, lie in lies.items():
        true = WRONG["offset_s"] if host == "lab2" else 0.0
        assert abs(lie.first - true) < 2e-3 + lie.uncertainty, "the fake drifts from when it was made"
        assert lie.uncertainty < 5e-3
    lie = lies["lab2"]
    assert lie.last - lie.first == pytest.approx(WRONG["drift"] * lie.over, abs=2 * lie.uncertainty)

    # robots start when their clock says so: the same moment if their stamps are of one clock. The recorder has its
    # own, looks every 20 ms, and so gets one of two hundred poses as soon as it is there
    begun = [desk.typed(f"/{robot}/status")[-1].started for robot in read.trace.robots]
    assert np.ptp(begun) < 1e-5
    poses = [desk.typed(f"/{robot}/pose") for robot in read.trace.robots]
    under_way = [min(pose.logged - pose.stamp for pose in several) for several in poses]
    doubt = max(lie.uncertainty for lie in lies.values())  # of a busy machine: how well its clocks could be compared
    assert np.ptp(under_way) < 5e-3 + doubt
    assert -doubt < min(under_way) < 5e-3 + doubt
    assert "Clocks of other machines" in (desk.out / "report.html").read_text()


@pytest.mark.mechanism("hosts: way out")
def test_launchers_death_lands_everybody_and_clears_all(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, EACH, case="periodic", lab2=WRONG)
    flight = desk.run(*NEAR_TRIANGLE, "duration_s=20")
    desk.until_running(*TRIANGLE)
    recording = desk.out / "periodic.mcap"
    begun = recording.stat().st_size
    until(lambda: recording.stat().st_size > begun + CHUNK_BYTES, "the experiment comes to the disk")
    os.kill(flight.pid, signal.SIGKILL)
    until(lambda: not desk.busy(), "no process is left")
    flight.communicate(timeout=100)
    for robot in TRIANGLE:
        last = [f"{robot}: {state} (the starter is gone)" for state in ("landing", "done")]
        assert desk.said(robot).splitlines()[-2:] == last
    assert desk.read().complete


def test_machine_cut_off_lands_its_robots_only(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, EACH)
    flight = desk.run("--no-report", "duration_s=8")
    desk.until_running("CF01")
    try:
        lab["lab3"].unplug()
        cut = time.monotonic()
        until(lambda: not lab["lab3"].processes(), "its robots land by themselves, and are gone")
        assert time.monotonic() - cut > 3.0, "silence must last before it is believed"
        out = desk.end(flight, 1)
    finally:
        lab["lab3"].plug_in_again()
    assert re.search(r"Failed in event: CF01 at \d+\.\d s: was lost: its process ended", out), out
    assert "done (finished)" in desk.said("KH01")


def test_station_that_stands_still_loses_no_figures(lab, tmp_path):
    """As a small computer that swaps; it answers again before the end of the run."""
    desk = AtDesk(lab, tmp_path, EACH)
    flight = desk.run("--no-report", "duration_s=12")
    desk.until_running(*TRIANGLE)
    (station,) = [each for each in lab["lab2"].processes() if "station" in each.cmdline()]
    station.suspend()
    threading.Event().wait(ANSWER_S + DRIFT_S + 1.0)
    station.resume()
    out = desk.end(flight)
    assert "note: lab2: its station says nothing for 5 s" in out
    assert " Hz per robot" in out


@pytest.mark.parametrize("keys", [False, True], ids=["open", "lab"])
def test_estop_typed_on_a_machine_stops_all(lab, tmp_path, keys):
    desk = AtDesk(lab, tmp_path, EACH, keys=keys)
    if keys:
        desk.end(desk.begin("hosts install"))
    process = desk.run("duration_s=60", "--no-report")
    desk.until_running(*TRIANGLE)
    typed_there = [*lab["lab2"].command(str(lab["lab2"].folder / "zenpark")), "estop"]
    done = subprocess.run(typed_there, env=lab.environment, capture_output=True, text=True, check=False)
    if keys:  # only an operator may stop, who has no certificate there; the run at the desk gets it all the same
        assert (done.returncode, done.stdout) == (1, "")
        assert "NOT known to have stopped: CF01, KH01, KH02 (3 of 3 robots; " in done.stderr
    else:
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("stopped: CF01, KH01, KH02 (")
    assert "emergency stop by operator: zenpark estop" in desk.end(process, code=1)
    for robot in TRIANGLE:
        assert f"{robot}: done (emergency stop by operator: zenpark estop)" in desk.said(robot)


def test_a_short_cut_of_the_cable_lands_nobody(lab, tmp_path):
    """TCP sends what was lost again 3 s after the cut, although the cable is back after 2 s."""
    desk = AtDesk(lab, tmp_path, EACH)
    flight = desk.run("--no-report", "duration_s=10")
    desk.until_running("CF01")
    lab["lab3"].unplug()
    threading.Event().wait(CUT_S)
    lab["lab3"].plug_in_again()
    out, _ = flight.communicate(timeout=100)
    assert "lost CF01" not in out
    assert "done (finished)" in desk.said("CF01")
    until(lambda: not desk.busy(), "no process is left")


def test_dead_robot_on_a_machine_is_restarted_there(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, {"lab1": ["KH01"]})
    flight = desk.run("--no-report", "duration_s=12", 'on_loss="restart"')
    desk.until_running("KH01")
    (first,) = (each for each in lab["lab1"].processes() if "KH01" in each.cmdline())
    first.kill()
    out = desk.end(flight, 1)  # it was away for a part of the run
    for each in ("lost KH01: its process ended", "restart KH01: asked by on_loss", "changed KH01: takes part again"):
        assert each in out, out
    assert desk.said("KH01").count("done (finished)") == 1


def test_faults_of_machines_are_reported_with_remedy(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, EACH)
    text = desk.file.read_text().replace(str(lab["lab1"].folder / "zenpark"), "nowhere/zenpark")
    text = text.replace('"lab2"', '"10.77.0.99"').replace('"lab3"', f'"127.0.0.1@{lab["lab3"].address}"')
    desk.file.write_text(text)
    out = desk.end(desk.run(), 2)
    assert "lab1: there is no zenpark at 'nowhere/zenpark'; `./zenpark hosts install FILE` puts it there" in out
    assert "lab2: it cannot be reached; is it on" in out
    assert "lab3: none of our keys lets us in; ssh-copy-id" in out
    assert "Traceback" not in out
    known = lab.known_hosts.read_text()
    try:
        lab.known_hosts.write_text("")
        out = desk.end(desk.begin("hosts check", "--on", "lab1"), 1)
    finally:
        lab.known_hosts.write_text(known)
    assert "lab1: its host key is not known here; log in once by hand (ssh lab1)" in out


def test_machines_get_own_keys_and_fly_through_ssh(lab, tmp_path):
    desk = AtDesk(lab, tmp_path, TWO, keys=True)
    out = desk.end(desk.begin("hosts check"), 1)
    assert "lab1: has no certificates of KH01, CF01; `./zenpark hosts install FILE`" in out
    assert "lab2: has no certificates of KH02; `./zenpark hosts install FILE`" in desk.end(desk.run(), 2)
    shutil.rmtree(desk.out)
    desk.there["lab1"].mkdir(parents=True, exist_ok=True)
    shutil.copy(desk.keys / "KH02.key", desk.there["lab1"])  # it ran there yesterday

    out = desk.end(desk.begin("hosts install"))
    assert "lab1: certificates of KH01, CF01 put into" in out
    assert "removed KH02.key" in out
    for host, robots in TWO.items():
        there = desk.there[host]
        assert stat.S_IMODE(there.stat().st_mode) == 0o700
        wanted = {"ca.pem", *(f"{robot}.{end}" for robot in robots for end in ("pem", "key"))}
        assert {file.name for file in there.iterdir()} == wanted, "neither the authority's key nor others'"
        assert {stat.S_IMODE(file.stat().st_mode) for file in there.iterdir()} == {0o600}
    assert desk.end(desk.begin("hosts install")).count("has its certificates") == 2
    for robot in TRIANGLE:
        (desk.keys / f"{robot}.key").unlink()  # they are where they are needed
    assert desk.end(desk.begin("hosts check")).count("✓") == 14
    desk.flies()


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_remote_robots_reach_a_router_listening_for_them(lab, tmp_path, protocol):
    desk = AtDesk(lab, tmp_path, TWO, keys=True, network=f'listen = ["{protocol}/0.0.0.0:7447"]')
    desk.end(desk.begin("hosts install"))
    here = lab["desk"].address
    out = desk.end(desk.run(), 2)
    assert f"lab1: reaches the router at {here}, which stands in no router's certificate" in out
    shutil.rmtree(desk.out)
    authority.renew(desk.keys, ["router"], hosts=[here])
    desk.flies()


def test_robots_follow_a_clock_that_drifts_meanwhile(lab, tmp_path):
    drift = 2e-3  # forty times what is bad, so that seconds show it
    desk = AtDesk(lab, tmp_path, TWO, keys=True, all={"drift": drift})
    desk.end(desk.begin("hosts install"))
    desk.flies(8.0)
    for lie in desk.read().trace.clocks:
        assert lie.drift == pytest.approx(drift, abs=2 * lie.uncertainty / lie.over + 1e-4)
        gained, doubt = lie.last - lie.first, lie.uncertainty
        assert gained > 0.015
        assert lie.worst < 0.5 * gained + 2 * doubt
        for robot in lie.robots:
            states = desk.typed(f"/{robot}/state")
            assert all(later.stamp > earlier.stamp for earlier, later in itertools.pairwise(states))
            started = {each.started for each in desk.typed(f"/{robot}/status") if each.phase == "running"}
            assert len(started) == 1, "the start stays"
            poses = desk.typed(f"/{robot}/pose")
            late = [pose.logged - pose.stamp for pose in poses if pose.stamp > poses[-1].stamp - 3.0]
            assert min(late) > -0.5 * gained - doubt, "a stamp of tomorrow, if nobody had followed"
