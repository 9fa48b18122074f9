"""Experiments on several machines: network namespaces with a real sshd in each, also as a lab with mutual TLS."""

import contextlib
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
from experiments.recording import playback
from experiments.recording.topics import CHUNK_BYTES
from tests.system.lab import NEAR_TRIANGLE, ROOT, TRIANGLE, options, typed, until
from tests.system.machines import machines, why_not
from tests.system.secured import new_lab
from tools.commands.run import SPOILED

pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(why_not()), reason=why_not() or "-")]


ROBOTS = {"lab1": ["TB01", "KH01"], "lab2": ["KH02", "CF01"], "lab3": ["KH03", "CF02", "CF03"]}
CUT_S = 2.0
OFFSET_S, DRIFT = 0.2, 50e-6  # of the second machine


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    with machines(tmp_path_factory.mktemp("machines"), ["desk", *ROBOTS]) as made:
        yield made


def park_file(lab, folder, duration_s):
    """The reference experiment, its robots on the lab's machines."""
    text = catalogue.path("robotic-park").read_text("utf-8")
    text = text.replace("duration_s = 45.0", f"duration_s = {duration_s}").replace("at_s = 21.0", "at_s = 1.0")
    return on_hosts(lab, folder, text, ROBOTS)


def triangle_file(lab, folder, duration_s):
    """The first experiment, one robot on each machine: enough for what does not depend on their number."""
    text = catalogue.path("triangle").read_text("utf-8").replace("duration_s = 15.0", f"duration_s = {duration_s}")
    return on_hosts(lab, folder, text, dict(zip(ROBOTS, (["KH01"], ["KH02"], ["CF01"]), strict=True)))


def on_hosts(lab, folder, text, robots):
    for host, names in robots.items():
        wrong = {"offset_s": OFFSET_S, "drift": DRIFT} if host == "lab2" else {}
        zenpark = lab[host].zenpark_file(**wrong)
        text += f'\n[hosts.{host}]\naddress = "{host}"\nzenpark = "{zenpark}"\nrobots = {json.dumps(names)}\n'
    file = folder / "experiment.toml"
    file.write_text(text)
    return file


def begin_at_desk(lab, *arguments):
    return subprocess.Popen(
        lab["desk"].command(sys.executable, "-m", "tools.guard", *arguments),
        cwd=ROOT,
        env=lab.environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def output_of_success(flight, lab):
    """What a run said that went well; nothing of it is left on any machine."""
    out, _ = flight.communicate(timeout=100)
    assert flight.returncode in {0, SPOILED}, out
    until(lambda: not busy(lab), "nothing is left")
    return out


def busy(lab):
    """What still runs on any machine."""
    return [f"{name}: {process}" for name, each in lab.machines.items() for process in each.processes()]


def test_one_command_flies_reference_and_fetches_all_files(lab, tmp_path):
    file, folder = park_file(lab, tmp_path, 4.0), tmp_path / "run"
    flight = begin_at_desk(lab, "run", str(file), "--case", "periodic", "--out", str(folder), "--anyway", "--json")
    assert "lab2/CF01| CF01: running" in output_of_success(flight, lab), "output is streamed, with where it comes from"

    for robots in ROBOTS.values():
        for robot in robots:
            log = (folder / "logs" / f"periodic-{robot}.log").read_text()
            assert [f"{robot}: running", f"{robot}: done (finished)"] == re.findall(r".*(?:running|done.*)", log)
    read = playback.read(folder / "periodic.mcap")
    assert read.complete
    trace = read.trace
    assert not trace.lost.any()
    assert np.isfinite(trace.true_position).all(axis=(1, 2)).mean() > 0.99

    lies = {lie.host: lie for lie in trace.clocks}
    assert set(lies) == set(ROBOTS)
    assert lies["lab2"].robots == ("KH02", "CF01")
    for host, lie in lies.items():
        true = OFFSET_S if host == "lab2" else 0.0
        assert abs(lie.first - true) < 2e-3 + lie.uncertainty, "the fake drifts from when it was made"
        assert lie.uncertainty < 5e-3
    drifted = lies["lab2"].last - lies["lab2"].first
    assert drifted == pytest.approx(DRIFT * lies["lab2"].over, abs=2 * lies["lab2"].uncertainty)

    # robots start when their clock says so: the same moment if their stamps are of one clock. The recorder has its
    # own, looks every 20 ms, and so gets one of two hundred poses as soon as it is there
    begun, under_way = {}, {}
    for robot in trace.robots:
        begun[robot] = typed(folder / "periodic.mcap", f"/{robot}/status")[-1].started
        poses = typed(folder / "periodic.mcap", f"/{robot}/pose")
        under_way[robot] = min(pose.received - pose.stamp for pose in poses)
    assert np.ptp(list(begun.values())) < 1e-5
    doubt = max(lie.uncertainty for lie in lies.values())  # of a busy machine: how well its clocks could be compared
    assert np.ptp(list(under_way.values())) < 5e-3 + doubt
    assert -doubt < min(under_way.values()) < 5e-3 + doubt
    report = (folder / "report.html").read_text()
    assert "Clocks of other machines" in report
    assert re.search(r"\+20\d\.\d{3}", report)


@pytest.mark.mechanism("hosts: way out")
def test_launchers_death_lands_everybody_and_clears_all(lab, tmp_path):
    file, folder = triangle_file(lab, tmp_path, 20.0), tmp_path / "run"
    words = options("--case", "periodic", "--out", folder, "--anyway", *NEAR_TRIANGLE)
    flight = begin_at_desk(lab, "run", str(file), *words)
    logs = folder / "logs"
    for robot in TRIANGLE:
        until(lambda robot=robot: f"{robot}: running" in said(logs, robot, "periodic"), "it runs", 60.0)
    recording = folder / "periodic.mcap"
    begun = recording.stat().st_size
    until(lambda: recording.stat().st_size > begun + CHUNK_BYTES, "the experiment comes to the disk")
    os.kill(flight.pid, signal.SIGKILL)
    until(lambda: not busy(lab), "nobody is left")
    flight.communicate(timeout=30)
    for robot in TRIANGLE:
        assert said(logs, robot, "periodic").splitlines()[-2:] == [
            f"{robot}: landing (the starter is gone)",
            f"{robot}: done (the starter is gone)",
        ]
    assert playback.read(recording).complete


def begun(lab, file, folder):
    """A run of the triangle in which CF01 runs."""
    words = ("--case", "event", "--out", str(folder), "--anyway", "--no-report")
    flight = begin_at_desk(lab, "run", str(file), *words)
    until(lambda: "running" in said(folder / "logs", "CF01"), "it runs", 60.0)
    return flight


def said(logs, robot, case="event"):
    file = logs / f"{case}-{robot}.log"
    return file.read_text() if file.exists() else ""


def test_machine_cut_off_lands_its_robots_only(lab, tmp_path):
    file, folder = triangle_file(lab, tmp_path, 8.0), tmp_path / "run"
    flight = begun(lab, file, folder)
    try:
        lab["lab3"].unplug()
        cut = time.monotonic()
        until(lambda: not lab["lab3"].processes(), "its robots land by themselves, and are gone")
        assert time.monotonic() - cut > 3.0, "silence must last before it is believed"
        out, _ = flight.communicate(timeout=60)
    finally:
        lab["lab3"].plug_in_again()
    assert flight.returncode == 1, out
    assert re.search(r"Failed in event: CF01 at \d+\.\d s: was lost: its process ended", out), out
    assert "done (finished)" in said(folder / "logs", "KH01")
    until(lambda: not busy(lab), "nothing is left")


def test_a_short_cut_of_the_cable_lands_nobody(lab, tmp_path):
    """TCP sends what was lost again 3 s after the cut, although the cable is back after 2 s."""
    file, folder = triangle_file(lab, tmp_path, 10.0), tmp_path / "run"
    flight = begun(lab, file, folder)
    lab["lab3"].unplug()
    threading.Event().wait(CUT_S)
    lab["lab3"].plug_in_again()
    out, _ = flight.communicate(timeout=60)
    assert "lost CF01" not in out
    assert "done (finished)" in said(folder / "logs", "CF01")
    until(lambda: not busy(lab), "nothing is left")


def test_dead_robot_on_a_machine_is_restarted_there(lab, tmp_path):
    file, folder = tmp_path / "x.toml", tmp_path / "run"
    text = catalogue.path("triangle").read_text("utf-8").replace("duration_s = 15.0", "duration_s = 12.0")
    text = text.replace("seed = 1 ", 'on_loss = "restart"\nseed = 1 ')
    file.write_text(
        f'{text}\n[hosts.lab1]\naddress = "lab1"\nzenpark = "{lab["lab1"].zenpark_file()}"\nrobots = ["KH01"]\n'
    )
    flight = begin_at_desk(lab, "run", str(file), "--case", "event", "--out", str(folder), "--no-report")
    until(lambda: "running" in said(folder / "logs", "KH01"), "it runs", 60.0)
    (first,) = (each for each in lab["lab1"].processes() if "KH01" in each.cmdline())
    first.kill()
    out, _ = flight.communicate(timeout=90)
    assert flight.returncode == 1, out  # it was away for a part of the run
    for each in ("lost KH01: its process ended", "restart KH01: asked by on_loss", "changed KH01: takes part again"):
        assert each in out, out
    assert said(folder / "logs", "KH01").count("done (finished)") == 1
    until(lambda: not busy(lab), "nothing is left")


def test_faults_of_machines_are_reported_with_remedy(lab, tmp_path):
    file = park_file(lab, tmp_path, 4.0)
    text = file.read_text()
    text = text.replace(str(lab["lab1"].folder / "zenpark"), "nowhere/zenpark")
    text = text.replace('"lab2"', '"10.77.0.99"').replace('"lab3"', f'"127.0.0.1@{lab["lab3"].address}"')
    file.write_text(text)
    flight = begin_at_desk(lab, "run", str(file), "--case", "event", "--out", str(tmp_path / "run"), "--anyway")
    out, _ = flight.communicate(timeout=60)
    assert flight.returncode == 2
    assert "lab1: there is no zenpark at 'nowhere/zenpark'; `./zenpark hosts install FILE` puts it there" in out
    assert "lab2: it cannot be reached; is it on" in out
    assert "lab3: none of our keys lets us in; ssh-copy-id" in out
    assert "Traceback" not in out
    known = lab.known_hosts.read_text()
    try:
        lab.known_hosts.write_text("")
        checked = begin_at_desk(lab, "hosts", "check", str(file), "--on", "lab1")
        out, _ = checked.communicate(timeout=60)
    finally:
        lab.known_hosts.write_text(known)
    assert checked.returncode == 1
    assert "lab1: its host key is not known here; log in once by hand (ssh lab1)" in out


LAB_ROBOTS = {"lab1": ["KH01", "CF01"], "lab2": ["KH02"]}


class Laboratory:
    """The file of an experiment with hosts, its lab beside it, and what each host was sent."""

    def __init__(self, lab, folder, network="", *, drift=0.0):
        self.lab, self.keys, self.file, self.out = lab, folder / "lab", folder / "triangle.toml", folder / "run"
        text = catalogue.path("triangle").read_text("utf-8")
        text += f'\n[network]\nlab = "lab"\n{network}\n'
        self.there = {host: folder / "there" / host for host in LAB_ROBOTS}
        for host, robots in LAB_ROBOTS.items():
            text += f'\n[hosts.{host}]\naddress = "{host}"\nzenpark = "{lab[host].zenpark_file(drift=drift)}"\n'
            text += f'lab = "{self.there[host]}"\nrobots = {json.dumps(robots)}\n'
        self.file.write_text(text, "utf-8")
        new_lab(self.keys)

    def finish_command(self, *arguments, limit_s=60.0):
        """Exit code and all that it said."""
        command, *rest = arguments
        process = begin_at_desk(self.lab, command, *rest[: command != "run"], str(self.file), *rest[command != "run" :])
        try:
            out, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            out, _ = process.communicate()
        return 0 if process.returncode == SPOILED else process.returncode, out

    def fly(self, duration_s=2.0):
        more = ("--case", "event", f"duration_s={duration_s}", "--anyway", "--no-report", "--out", self.out)
        return self.finish_command("run", *options(*more))

    def flew(self, duration_s=2.0):
        code, out = self.fly(duration_s)
        assert code == 0, out
        until(lambda: not busy(self.lab), "nothing is left")
        trace = playback.read(self.out / "event.mcap").trace
        assert not trace.lost.any()
        for robot in trace.robots:
            log = (self.out / "logs" / f"event-{robot}.log").read_text()
            assert f"{robot}: done (finished)" in log, log


def test_machines_get_own_keys_and_fly_through_ssh(lab, tmp_path):
    made = Laboratory(lab, tmp_path)
    code, out = made.finish_command("hosts", "check")
    assert code == 1, out
    assert "lab1: has no certificates of KH01, CF01; `./zenpark hosts install FILE`" in out
    code, out = made.fly()
    assert code == 2, out
    assert "lab2: has no certificates of KH02; `./zenpark hosts install FILE`" in out
    shutil.rmtree(made.out)
    with contextlib.suppress(FileNotFoundError):
        made.there["lab1"].mkdir(parents=True)
        shutil.copy(made.keys / "KH02.key", made.there["lab1"])  # it ran there yesterday

    code, out = made.finish_command("hosts", "install")
    assert code == 0, out
    assert "lab1: certificates of KH01, CF01 put into" in out
    assert "removed KH02.key" in out
    for host, robots in LAB_ROBOTS.items():
        there = made.there[host]
        assert stat.S_IMODE(there.stat().st_mode) == 0o700
        wanted = {"ca.pem", *(f"{robot}.{end}" for robot in robots for end in ("pem", "key"))}
        assert {file.name for file in there.iterdir()} == wanted, "neither the authority's key nor others'"
        assert {stat.S_IMODE(file.stat().st_mode) for file in there.iterdir()} == {0o600}
    code, out = made.finish_command("hosts", "install")
    assert (code, out.count("has its certificates")) == (0, 2), out
    for robot in ("KH01", "KH02", "CF01"):
        (made.keys / f"{robot}.key").unlink()  # they are where they are needed
    code, out = made.finish_command("hosts", "check")
    assert code == 0, out
    assert out.count("✓") == 14, out
    made.flew()


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_remote_robots_reach_a_router_listening_for_them(lab, tmp_path, protocol):
    made = Laboratory(lab, tmp_path, f'listen = ["{protocol}/0.0.0.0:7447"]')
    assert made.finish_command("hosts", "install")[0] == 0
    code, out = made.fly()
    assert code == 2, out
    here = lab["desk"].address
    assert f"lab1: reaches the router at {here}, which stands in no router's certificate" in out
    shutil.rmtree(made.out)
    authority.renew(made.keys, ["router"], hosts=[here])
    made.flew()


def test_robots_follow_a_clock_that_drifts_meanwhile(lab, tmp_path):
    drift = 2e-3  # forty times what is bad, so that seconds show it
    made = Laboratory(lab, tmp_path, drift=drift)
    assert made.finish_command("hosts", "install")[0] == 0
    made.flew(8.0)
    file = made.out / "event.mcap"
    lies = {lie.host: lie for lie in playback.read(file).trace.clocks}
    for host, robots in LAB_ROBOTS.items():
        lie = lies[host]
        assert lie.drift == pytest.approx(drift, abs=2 * lie.uncertainty / lie.over + 1e-4)
        gained, doubt = lie.last - lie.first, lie.uncertainty
        assert gained > 0.015
        assert lie.worst < 0.5 * gained + 2 * doubt
        for robot in robots:
            states = typed(file, f"/{robot}/state")
            assert all(later.stamp > earlier.stamp for earlier, later in itertools.pairwise(states))
            status = typed(file, f"/{robot}/status")
            assert len({each.started for each in status if each.phase == "running"}) == 1, "the start stays"
            poses = typed(file, f"/{robot}/pose")
            late = [pose.received - pose.stamp for pose in poses if pose.stamp > poses[-1].stamp - 3.0]
            assert min(late) > -0.5 * gained - doubt, "a stamp of tomorrow, if nobody had followed"
