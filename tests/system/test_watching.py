"""A run as it is watched from another shell: its table, attached to a router; its recording, played onto a network."""

import threading
from contextlib import contextmanager

import msgspec
import pytest

from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network.keys import Keys
from experiments.file.document import load
from experiments.run import simulate
from tests.commands import zenpark
from tests.system.lab import typed
from tests.tools.commands.test_live_table import STATUS

pytestmark = pytest.mark.system


@contextmanager
def reporting(session, names, hazard):
    """Robots that report ten times a second; the last one has a hazard, and uses half a core."""
    keys, over, begin = Keys(), threading.Event(), Clock().utc()
    tokens = [pubsub.alive_token(session, keys.alive(name)) for name in names]
    publishers = {name: pubsub.publisher(session, keys.status(name), messages.JSON) for name in names}

    def report():
        while not over.wait(0.1):
            now = Clock().utc()
            for name in names:
                bad = name == names[-1]
                status = msgspec.structs.replace(
                    STATUS, robot=name, stamp=now, hazard=hazard if bad else "", cpu_s=(now - begin) * 0.5 * bad
                )
                publishers[name].put(messages.encode(status))

    thread = threading.Thread(target=report)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        del tokens


@pytest.mark.mechanism("table of a run from another shell")
def test_top_shows_a_routers_robots_worst_first(router, watcher):
    with reporting(watcher.session, ["alpha", "beta", "gamma"], "hold: link silence"):
        done = zenpark("top", "--connect", router.endpoint, timeout_s=30.0)
    title, heads, first, *others = done.stdout.splitlines()
    assert "held 1" in title
    assert "running 2" in title
    assert heads.split()[:2] == ["robot", "phase"]
    assert first.split()[:2] == ["gamma", "held"]
    assert "50 %" in first
    assert [line.split()[0] for line in others[:2]] == ["alpha", "beta"]


@pytest.mark.mechanism("recording played onto a network")
def test_recording_plays_with_keys_and_payloads_as_flown(router, watcher, tmp_path):
    simulate(load("triangle", "duration_s=3.0", "timeline=[]"), cases=["event"], folder=tmp_path)
    seen = {}

    def keep(sample):
        seen.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())

    listening = watcher.session.declare_subscriber("park/**", keep)
    zenpark("replay", tmp_path, "--rate", "8", "--connect", router.endpoint)
    sent = [messages.decode(each, messages.JSON, messages.Pose) for each in seen["park/CF01/pose"]]
    assert [(p.seq, p.stamp, p.position) for p in sent] == [
        (p.seq, p.stamp, tuple(p.position)) for p in typed(tmp_path / "event.mcap", "/CF01/pose")
    ]
    assert {"park/run/event", "park/run/experiment", "park/CF01/state", "park/CF01/status"} <= seen.keys()
    for robot in ("park/KH01/state", "park/KH02/state"):
        assert len(seen[robot]) == len(typed(tmp_path / "event.mcap", robot.removeprefix("park")))
    seen.clear()
    token = pubsub.alive_token(watcher.session, Keys().conductor)
    refused = zenpark("replay", tmp_path, "--connect", router.endpoint, code=2)
    assert seen == {}
    assert "a run is up (park/run/conductor)" in refused.stderr
    token.undeclare()
    listening.undeclare()
