"""A replay ends as soon as a live robot of a recorded name is on the network."""

from __future__ import annotations

import threading

import pytest

from agents.errors import ExplainedError
from agents.network import pubsub
from agents.network.keys import Keys
from experiments.file.document import load
from experiments.run import simulate
from experiments.view.broadcast import Broadcast
from experiments.view.replay import Clock
from tests.fuzz.loopnet import Mute, Net

KEYS = Keys()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    simulate(load("triangle", "duration_s=2.0", "timeline=[]"), cases=["event"], folder=folder)
    return folder / "event.mcap"


@pytest.mark.parametrize(
    ("token", "shown"),
    [
        (KEYS.life(KEYS.alive("KH01"), "beef"), "park/KH01/alive"),  # of a recorded name
        (KEYS.alive("other"), "park/other/alive"),
        (KEYS.claim(KEYS.alive("KH01"), KEYS.rank(1.0, "beef")), ""),  # of a robot that is refused
        (KEYS.life(KEYS.alive("KH01"), "f00d"), ""),  # its own
    ],
)
def test_replay_ends_when_another_process_owns_a_name(token, shown, recording, monkeypatch):
    sent: list[bytes] = []

    class Counted(Mute):
        def put(self, payload, **_):
            sent.append(payload)
            if len(sent) == 20:
                net.deliver(f"{token}\0\0".encode())

    with Net().worn() as net:
        monkeypatch.setattr(pubsub, "publisher", lambda *_, **__: Counted())
        played = Broadcast(net.session, recording, watch_s=0.0)
        clock = Clock(0.0, played.end - played.begin)
        clock.playing, clock.speed = True, 10.0
        if shown:
            with pytest.raises(ExplainedError, match=shown):
                played.run(threading.Event(), clock)
            assert clock.t < clock.end
        else:
            assert played.run(threading.Event(), clock) > len(sent) > 20
