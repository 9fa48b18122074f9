"""A lab on several machines: three robots on two of them, over mutual TLS, started from a third with one command."""

import contextlib
import itertools
import json
import shutil
import stat
import subprocess

import pytest

from experiments.file import catalogue
from experiments.real_time.hosts import authority
from experiments.recording import playback
from tests.system.lab import options, typed, until
from tests.system.machines import machines, why_not
from tests.system.test_machines import begin_at_desk, busy
from tools.commands.run import SPOILED

LACKING = why_not()
pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(LACKING), reason=LACKING)]

ROBOTS = {"lab1": ["KH01", "CF01"], "lab2": ["KH02"]}


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    with machines(tmp_path_factory.mktemp("machines"), ["desk", *ROBOTS]) as made:
        yield made


class Laboratory:
    """The file of an experiment with hosts, its lab beside it, and what each host was sent."""

    def __init__(self, lab, folder, network="", *, drift=0.0):
        self.lab, self.keys, self.file, self.out = lab, folder / "lab", folder / "triangle.toml", folder / "run"
        text = catalogue.path("triangle").read_text("utf-8")
        text += f'\n[network]\nlab = "lab"\n{network}\n'
        self.there = {host: folder / "there" / host for host in ROBOTS}
        for host, robots in ROBOTS.items():
            text += f'\n[hosts.{host}]\naddress = "{host}"\nzenpark = "{lab[host].zenpark_file(drift=drift)}"\n'
            text += f'lab = "{self.there[host]}"\nrobots = {json.dumps(robots)}\n'
        self.file.write_text(text, "utf-8")
        robots = [robot for each in ROBOTS.values() for robot in each]
        authority.create(self.keys, {**{role: role for role in authority.SERVICES}, **dict.fromkeys(robots, "robot")})

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
    for host, robots in ROBOTS.items():
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
    for host, robots in ROBOTS.items():
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
