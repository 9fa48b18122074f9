"""World and central controller that were replaced while they stood still, or were cut off, send nothing more."""

from __future__ import annotations

import math
import signal
import threading
from pathlib import Path

import pytest

from agents.decision.centralised import CentreGoal
from agents.network import name_ownership, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.name_ownership import NameTaken, OwnershipCheck, OwnershipTiming
from tests.conftest import RouterProcess
from tests.experiments.real_time.processes import joined
from tests.experiments.real_time.processes.joined import KEYS
from tests.network import Attentive, Mute, Net, Reply, Sample
from tests.system.lab import Started
from tests.waiting import until


@pytest.mark.slow
@pytest.mark.parametrize("way", ["still", "cut off"])
@pytest.mark.parametrize("what", ["world", "centre"])
def test_replaced_process_sends_nothing(what, way, monkeypatch):
    sent: list[bytes] = []
    now, silent = [0.0], [math.inf]
    over = threading.Event()
    token = KEYS.world_alive if what == "world" else KEYS.centre_alive

    class Counted(Mute):
        def put(self, payload, **_):
            sent.append(payload)
            if len(sent) == 10 and way == "cut off":
                silent[0] = 0.0
            if len(sent) == 20:
                net.replies = [Reply(Sample(Keys.life(token, "beef"), "", b""), good=True)]
                now[0] += 60.0 if way == "still" else 0.0
                silent[0] = math.inf
            if len(sent) == 40:
                over.set()

    monkeypatch.setattr(name_ownership, "uptime", lambda: now[0])
    monkeypatch.setattr(Attentive, "silent_since", lambda *_: silent[0])
    ownership = OwnershipCheck([token], timing=OwnershipTiming(vanish_s=0.0))
    with Net().worn() as net:
        monkeypatch.setattr(pubsub, "publisher", lambda *_, **__: Counted())
        process = (joined.joined_world if what == "world" else joined.centre)(net, ownership=ownership)
        if what == "centre":
            monkeypatch.setattr(process.centre, "decide", lambda *_: [CentreGoal(0, (0.0, 0.0, 0.0), 0.0, 0.0)])
        with pytest.raises(NameTaken):
            process.run(over)
    assert 20 <= len(sent) <= 21  # a tick of the world has up to two


TWO = """
title = "two"
duration_s = 60.0
architecture = "centralised"
[robots]
KH01 = { kind = "khepera4", body = "world", start = [0.0, 0.0] }
KH02 = { kind = "khepera4", body = "world", start = [0.0, 0.5] }
"""


@pytest.mark.system
@pytest.mark.parametrize(
    "what", [pytest.param("world", marks=pytest.mark.mechanism("name ownership: world replaced")), "centre"]
)
def test_frozen_and_replaced(what: str, router: RouterProcess, tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    file.write_text(TWO)
    token = KEYS.world_alive if what == "world" else KEYS.centre_alive
    started: list[Started] = []

    def start() -> None:
        started.append(Started(f"experiments.real_time.processes.{what}", str(file), "--connect", router.endpoint))
        assert started[-1].process.stdout is not None
        assert started[-1].process.stdout.readline().startswith(f"{what} ready")

    with network.open_session([router.endpoint], name="test") as session:

        def owners() -> int:
            tokens = network.tokens_present(session, Keys.lives(token)) or set()
            return sum(Keys.life_of(each) is not None for each in tokens)

        try:
            start()
            old = started[0].process
            old.send_signal(signal.SIGSTOP)
            until(lambda: not owners(), "its lease is over")
            start()
            old.send_signal(signal.SIGCONT)
            assert old.wait(30.0) == 2
            assert old.stdout is not None
            assert f"another process has taken the name '{what}' in the realm 'park'" in old.stdout.read()
            assert started[1].process.poll() is None
        finally:
            for each in started:
                each.process.send_signal(signal.SIGCONT)
                each.end()
