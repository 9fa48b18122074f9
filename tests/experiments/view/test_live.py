"""A view of a run that goes on: what it shows, what it may do, and its sign of life; a replay gives way to robots."""

import threading
from itertools import product
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from agents.errors import ExplainedError
from agents.network import lab, pubsub
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.file.document import load
from experiments.run import simulate, simulate_seeds
from experiments.scene.stage import SceneModel
from experiments.view import live
from experiments.view.acting import WatchedRun, may_act, parameters
from experiments.view.broadcast import Broadcast
from experiments.view.heartbeat import SLOWEST_S, DataAge, frame_s, mark
from experiments.view.replay import ReplayClock
from tests.cases import mostly_slow
from tests.network import Mute, Net
from tests.runs import recorded


@pytest.mark.parametrize("size", [(12.0, 12.0, 1.1), (4.3, 2.0, 0.95), (0.5, 6.0, 2.0)])
@pytest.mark.parametrize("aspect", [0.46, 0.85, 1.24, 3.0])
def test_whole_arena_is_in_sight_and_fills_page(size, aspect):
    place, at = live.standpoint(size, aspect)
    ahead = (at - place) / np.linalg.norm(at - place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = np.array(list(product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)))) * size - place
    depth = np.tan(0.5 * live.FOV) * (seen @ ahead)
    over, up = seen @ right / depth / aspect, seen @ np.cross(right, ahead) / depth
    low, high = live.ABOVE if aspect < live.PHONE else live.FREE
    assert (depth > 0.0).all()
    assert np.abs(over).max() <= 0.9201
    assert low - 1e-4 <= up.min() <= up.max() <= high + 1e-4
    assert max(np.ptp(over) / np.ptp(live.FREE), np.ptp(up) / (high - low)) == pytest.approx(1.0)


@pytest.mark.parametrize("aspect", [0.0, float("nan"), float("inf")])
def test_camera_of_a_hidden_page_has_a_place(aspect):
    page = MagicMock(client_id=1)
    page.camera.aspect = aspect
    live.Camera(MagicMock(get_clients=lambda: {1: page})).show(np.array([4.0, 4.0, 1.0]))
    assert np.isfinite([*page.camera.position, *page.camera.look_at]).all()


@pytest.mark.parametrize(
    ("added", "asked", "seconds"),
    [
        ([], (1000.0, 0.0), None),
        ([(1000.0, 1000.1, 10.0)], (1000.1, 10.0), 0.1),
        ([(1000.0, 1000.1, 10.0), (1001.0, 1046.0, 56.0)], (1046.0, 56.0), 45.0),  # 45 s in a queue
        ([(1000.5, 1000.0, 10.0)], (1133.0, 143.0), 133.0),  # silence, and a clock ahead by half a second
        ([(1000.0, 1000.0 + 86400.0, 10.0)], (1000.0 + 86400.0, 10.0), 0.0),  # a recording
        ([(1000.0, 1000.0 + 86400.0, 10.0)], (1000.0 + 86403.0, 13.0), 3.0),
    ],
)
def test_age_of_poses(added, asked, seconds):
    """Stamp, UTC and own clock of poses; then UTC and own clock [s]."""
    age = DataAge()
    for stamp, utc, now in added:
        age.add(stamp, utc=utc, now=now)
    assert age.seconds(*asked) == (None if seconds is None else pytest.approx(seconds))
    assert age.recorded == (asked[0] > 80_000.0)


def test_mark_escapes_and_states_the_time():
    text = mark(3, 1000.0, 0.25, "<b>'", over=True)
    assert "data-stage='3'" in text
    assert "data-picture='999.750'" in text
    assert "<b>" not in text
    assert "data-picture=''" in mark(3, 1000.0, None)
    periods = [frame_s(lag, 0.04) for lag in (0.0, 1.0, 2.0, 3.0, 100.0)]
    assert (periods[:2], periods[-1]) == ([0.04, 0.04], SLOWEST_S)
    assert periods == sorted(periods), "slow pages get fewer pictures"


def test_only_an_operator_of_a_lab_gives_orders(tmp_path):
    roles = {"operator": "operator", "observer": "observer", "ana": "operator"}
    known = {name: lab.Identity(role, name, "1", "2027-01-01T00:00:00") for name, role in roles.items()}
    (tmp_path / lab.REGISTER).write_bytes(msgspec.json.encode(lab.Register(known)))

    def acts(name, folder=None):
        endpoints = ["tcp/127.0.0.1:7447"] if folder is None else lab.secured(["tls/127.0.0.1:7447"], folder)
        return may_act(WatchedRun(endpoints, "park", name))

    found = {name: acts(name, tmp_path) for name in (*known, "stranger")}
    assert found == {"operator": True, "observer": False, "ana": True, "stranger": False}
    assert (acts("operator"), acts("observer"), acts("operator", tmp_path / "no")) == (True, False, False)


def test_trigger_and_law_numbers_have_sliders():
    park = SceneModel.of_plan(load("robotic-park").cases()["event"])
    assert [(each.label, each.value) for each in parameters(park)] == [
        ("trigger.threshold [m]", 0.01), ("clamp [m]", 0.1), ("tracking_gain [1/(m²·decision)]", 3.0),
    ]  # fmt: skip


@pytest.mark.slow
def test_watched_virtual_run_is_unchanged_bit_by_bit():
    pytest.importorskip("viser", reason="needs viser")
    from experiments.view import paced  # noqa: PLC0415
    from experiments.view.serving import served  # noqa: PLC0415

    read = load("robotic-park", "duration_s=1.0", "timeline=[]", "cases={}")
    with served(int(free_endpoint(preferred_port=0).rpartition(":")[2]), dark=True) as server:
        page = paced.PacedView(server, pace=100.0, dark=True, page_s=0.0)
        (watched,) = simulate_seeds(read, [1], watch=page.begin)
    alone = simulate(read, seed=1)
    for case, trace in alone.traces.items():
        np.testing.assert_array_equal(watched.traces[case].true_position, trace.true_position)
    assert page.clock.t > 0.0


KEYS = Keys()


@pytest.mark.parametrize(
    ("token", "shown"),
    mostly_slow(
        [
            (KEYS.life(KEYS.alive("KH01"), "beef"), "park/KH01/alive"),  # of a recorded name
            (KEYS.alive("other"), "park/other/alive"),
            (KEYS.claim(KEYS.alive("KH01"), KEYS.rank(1.0, "beef")), ""),  # of a robot that is refused
            (KEYS.life(KEYS.alive("KH01"), "f00d"), ""),  # its own
        ],
        3,
    ),
)
def test_replay_ends_when_another_process_owns_a_name(token, shown, monkeypatch):
    sent: list[bytes] = []

    class Counted(Mute):
        def put(self, payload, **_):
            sent.append(payload)
            if len(sent) == 20:
                net.deliver(f"{token}\0\0".encode())

    with Net().worn() as net:
        monkeypatch.setattr(pubsub, "publisher", lambda *_, **__: Counted())
        folder = recorded("triangle", "duration_s=2.0", "timeline=[]", cases=("event",)).folder
        played = Broadcast(net.session, folder / "event.mcap", watch_s=0.0)
        clock = ReplayClock(0.0, played.end - played.begin)
        clock.playing, clock.speed = True, 10.0
        if shown:
            with pytest.raises(ExplainedError, match=shown):
                played.run(threading.Event(), clock)
            assert clock.t < clock.end
        else:
            assert played.run(threading.Event(), clock) > len(sent) > 20


def test_page_outlives_a_picture_that_fails(capsys):
    server, rounds = MagicMock(), iter((False, False, True))
    server.gate.lag.return_value = 0.0
    watched = WatchedRun((), "park", "observer")
    with Net().worn() as net:
        page = live.LiveView(server, net.session, watched, dark=False, acting=None)
        server.atomic.side_effect = ValueError("no such mesh")
        page.run(lambda: next(rounds))
    assert capsys.readouterr().err.count("the picture fails: ValueError: no such mesh") == 1
    assert "no such mesh" in server.gui.add_html.return_value.content
