"""A process that cannot print goes on where robots need it, and lands them where it watches for them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from agents.network import session as network
from agents.network.keys import Keys
from experiments.real_time.processes import joining
from tests.conftest import RouterProcess
from tests.network import Net
from tests.waiting import until

WORLD = """
title = "one"
duration_s = 60.0
[robots]
KH01 = { kind = "khepera4", body = "world", start = [0.0, 0.0] }
"""


class Gone:
    """Watch of a token that has vanished."""

    def __init__(self, *_: object) -> None:
        self._told = [("", False)]

    def changes(self) -> list[tuple[str, bool]]:
        told, self._told = self._told, []
        return told


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_robots_land_although_nobody_reads_their_output(monkeypatch: pytest.MonkeyPatch) -> None:
    def unread(*_: object, **__: object) -> None:
        raise BrokenPipeError

    signals: list[int] = []
    monkeypatch.setattr(joining.pubsub, "AliveWatch", Gone)
    monkeypatch.setattr(network, "connected", lambda _: True)
    monkeypatch.setattr("builtins.print", unread)
    monkeypatch.setattr(os, "kill", lambda _, number: signals.append(number))
    with Net().worn() as net:
        watch = joining.ConductorWatch(net.session, Keys(), 0.0)  # type: ignore[arg-type]
        until(lambda: signals, "it ends its process")
        watch.close()
    assert signals == [signal.SIGTERM]


@pytest.mark.system
def test_full_disk_of_a_log_ends_no_world(router: RouterProcess, tmp_path: Path) -> None:
    file = tmp_path / "one.toml"
    file.write_text(WORLD)
    module = "experiments.real_time.processes.world"
    command = [sys.executable, "-m", module, str(file), "--connect", router.endpoint, "--lifeline"]
    with (
        Path("/dev/full").open("w") as full,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=full, stderr=full, bufsize=0) as process,
        network.open_session([router.endpoint], name="test") as session,
    ):
        assert process.stdin is not None

        def there() -> bool:
            assert process.poll() is None
            process.stdin.write(b"\n")
            return bool(network.tokens_present(session, Keys().world_alive))

        until(there, "the world is up")
        process.terminate()
        process.stdin.close()
        assert process.wait(20.0) == 0
