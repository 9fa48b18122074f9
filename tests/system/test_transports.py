"""The same small experiment over each transport, and robots that join from another machine with their certificates."""

import subprocess
import sys
from pathlib import Path

import pytest

from agents.network.endpoints import free_endpoint
from experiments.file.document import load
from experiments.real_time.hosts import authority
from experiments.run import reopen
from tests.system import machines
from tests.system.lab import PATIENCE_S, Flight, until

pytestmark = pytest.mark.system

SHORT = ("--case", "periodic", "--no-report", "--set", "duration_s=3", "--set", "rates.body_hz=50")


def found(folder, *hosts):
    """A lab for the triangle."""
    robots = dict.fromkeys(load("triangle").experiment.robots, "robot")
    authority.create(folder, {**{role: role for role in authority.SERVICES}, **robots}, hosts=hosts)
    return folder


@pytest.mark.parametrize("protocol", ["unixsock-stream", "tls", "quic"])
def test_an_experiment_over_each_transport(tmp_path, protocol):
    secure = protocol in ("tls", "quic")
    listen = free_endpoint(0, protocol) if secure else f"{protocol}/{tmp_path}/router.sock"
    lab = ("--lab", str(found(tmp_path / "lab"))) if secure else ()
    flight = Flight(tmp_path / "run", "triangle", *SHORT, *lab, f'network.listen=["{listen}"]')
    code, _ = flight.finish()
    assert code == 0, flight.logs()
    assert f"router ready on {listen}" in (flight.folder / "logs" / "router.log").read_text()
    case = reopen(flight.folder).metrics["periodic"]
    assert case.lost == 0
    assert all(robot.messages > 100 for robot in case.robots)


@pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-")
def test_robots_join_from_another_machine_with_their_certificates(tmp_path):
    """The router listens beyond loopback; two robots come from another network namespace, one is started here."""
    with machines.machines(tmp_path / "net", ("front", "board")) as there:
        front, board = there["front"], there["board"]
        endpoint = f"tls/{front.address}:7447"
        found(tmp_path / "lab", front.address)
        file = tmp_path / "away.toml"
        text = Path(load("triangle").path).read_text()
        file.write_text(
            f'{text}\n[hosts.board]\nrobots = ["KH01", "KH02"]\n[network]\nlisten = ["{endpoint}"]\nlab = "lab"\n'
        )
        zenpark = [sys.executable, "-m", "tools.guard"]
        with (tmp_path / "run.log").open("w") as log:
            run = subprocess.Popen(
                front.command(*zenpark, "run", str(file), *SHORT, "--out", str(tmp_path / "run")),
                env=there.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
            until((tmp_path / "run" / "logs" / "router.log").exists, "the router starts", PATIENCE_S)
            robots = [
                subprocess.Popen(
                    board.command(
                        *zenpark, "agent", str(file), name, "--case", "periodic", "--connect", endpoint, "--once"
                    ),
                    env=there.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                )
                for name in ("KH01", "KH02")
            ]  # fmt: skip
            try:
                assert run.wait(60) == 0, (tmp_path / "run.log").read_text()
                assert [robot.wait(20) for robot in robots] == [0, 0]
            finally:
                for process in (run, *robots):
                    process.kill()
                    process.wait()
    case = reopen(tmp_path / "run").metrics["periodic"]
    assert case.lost == 0
    assert all(robot.messages > 100 for robot in case.robots)
