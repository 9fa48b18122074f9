"""A view of a run that goes on, and of a recording: what it shows, what it may do, and its sign of life."""

import os
import threading
import time
from dataclasses import replace
from itertools import product
from math import isfinite
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from agents.body.kinds import KINDS
from agents.errors import ExplainedError
from agents.network import lab, messages, pubsub
from agents.network.keys import Keys
from experiments.file import document
from experiments.file.document import load
from experiments.real_time.hosts.run_registry import RegisteredRun
from experiments.recording.playback import read_whole
from experiments.recording.reader import RecordingError
from experiments.scene import models
from experiments.scene.condition import PALED, RINGED, Condition, RobotRow, condition, robot_row
from experiments.scene.stage import BAD, FAIR, SceneModel, touched
from experiments.view import live
from experiments.view.acting import WatchedRun, may_act
from experiments.view.broadcast import Broadcast
from experiments.view.heartbeat import SLOWEST_S, DataAge, frame_s, mark
from experiments.view.observer import Observer, RobotReport
from experiments.view.panel import History, css, event_list, link_table, table
from experiments.view.replay import Film, ReplayClock, ReplayView, marks
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
    text, unknown = mark(3, 1000.0, 0.25, "<b>'", over=True), mark(3, 1000.0, None)
    assert "<b>" not in text
    for part, where in (("data-stage='3'", text), ("data-picture='999.750'", text), ("data-picture=''", unknown)):
        assert part in where
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


def test_virtual_run_plays_from_its_beginning_once_seen(film):
    server = MagicMock()
    view = ReplayView(server, [film], "a run", dark=False, pace=1.0)
    view.draw = lambda: None
    assert (view.clock.t, view.clock.speed, view.clock.playing) == (film.begin, 1.0, True)
    assert film.begin < 0.0
    for pages, moved in (((), False), (("page",), True)):
        server.get_clients.return_value, rounds = pages, iter((False, False, True))
        view.run(lambda rounds=rounds: next(rounds))
        assert (view.clock.t > film.begin) == moved


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


@pytest.fixture
def observed():
    """An observer of the reference experiment, and a function by which it receives messages."""
    with Net().worn() as net:
        observer = Observer(net.session, KEYS)

        def send(key, message):
            net.deliver(f"{key}\0{messages.JSON}\0".encode() + messages.encode(message))
            observer.update()

        plan = load("robotic-park").cases()["event"]
        told = document.case_document(plan, "event")
        net.deliver(f"{KEYS.experiment}\0{messages.JSON}\0".encode() + told)
        for name in plan.names:
            net.deliver(f"{KEYS.alive(name)}\0\0".encode())
        observer.update()
        yield observer, send


def seen(robot, x):
    """State of a robot of the reference experiment."""
    return KEYS.state(robot), messages.State(robot, 0, 10.0, "running", position=(x, 0.0, 0.0))


def test_contact_is_seen_while_it_happens(observed):
    observer, send = observed
    send(*seen("KH01", 0.0))
    send(*seen("KH02", 0.6))
    assert (observer.overlaps, list(observer.events)) == ([], [])
    for x in (0.1, 0.04, 0.05):
        send(*seen("KH02", x))
    (found,), radius = observer.overlaps, KINDS["khepera4"].radius
    assert found == ("KH01", "KH02", pytest.approx(2.0 * radius - 0.05))
    assert [(each.kind, each.source, each.text) for each in observer.events] == [("contact", "KH01", "touches KH02")]
    names, moment = observer.stage.names, observer.moment()
    touching = [name for name, each in zip(names, moment.condition, strict=True) if each == Condition.TOUCHING]
    assert touching == ["KH01", "KH02"]
    row = robot_row("KH02", Condition.TOUCHING, None, 0.0, 0.0, touches=touched("KH02", moment.overlaps))
    assert f"color:{css(BAD)};padding-left:1.2em'>touches KH01, 9.0 cm deep" in table([row], observer.stage)


def test_clock_stands_still_in_last_picture(monkeypatch):
    over = RegisteredRun("run", os.getpid(), "of another process", 0.0, "a run", "", [])
    server, times, status = MagicMock(), [], messages.Status("A", 100.0, "running", "", started=95.0)
    with Net().worn() as net:
        page = live.LiveView(server, net.session, WatchedRun((), "park", "observer"), dark=False, acting=None)
        monkeypatch.setattr(live, "connected", lambda _: True)
        monkeypatch.setattr(page._page.panel, "show_head", lambda _case, _phase, elapsed, *_: times.append(elapsed))
        observer, now = page.observer, time.monotonic()
        observer.robots["A"] = RobotReport(status=status, heard_at=now, alive=True)
        observer.age.add(now, now, now)
        for late in (0.0, 5.0, 10.0):
            monkeypatch.setattr(live.time, "monotonic", lambda late=late: now + late)
            page._plot(now + late, observer.moment())
            page._tabulate(observer.moment())
            page._watched = WatchedRun((), "park", "observer", over)
    assert times == pytest.approx([5.0, 5.0, 5.0], abs=1e-9)


def test_contacts_of_a_world_are_its_own(observed):
    observer, send = observed
    world = messages.WorldState(0.0, "pymunk", 1.0, 1.0, 0.0, paused=False, robots=["KH01", "KH02"])
    send(KEYS.world, world)
    send(*seen("KH01", 0.0))
    send(*seen("KH02", 0.1))
    assert observer.overlaps == []
    send(KEYS.contact, messages.Contact(10.0, "KH01", "KH02", 0.1, 0.001))
    send(*seen("KH02", 0.1))
    assert observer.overlaps == [("KH01", "KH02", 0.001)]


@pytest.fixture(scope="module", params=["distributed", "centralised"])
def recorded_case(request):
    """A recorded run, as the trace in memory and as a file."""
    architecture = f"architecture={request.param}"
    run = recorded("robotic-park", "duration_s=3.0", "timeline=[]", architecture, cases=("event",))
    return run.traces["event"], run.folder / "event.mcap"


@pytest.fixture
def film(recorded_case):
    return Film(read_whole(recorded_case[1]))


def test_replay_shows_contacts_that_a_world_reported(film):
    contact = messages.Contact(1.0, "KH01", "box", 0.1, 0.002)
    touched = Film(replace(film.recording, trace=replace(film.trace, contacts=(contact,))))
    for t, note in ((0.9, ""), (1.5, "touches box, 0.2 cm deep"), (2.1, "")):
        assert next(row.note for row in touched.rows(t) if row.name == "KH01") == note


def test_reason_of_an_early_end_stays(film):
    status = messages.Status("KH02", 0.0, "done", "its control loop hangs: no tick for 0.5 s")
    rows = [
        robot_row("KH02", condition(each), each, 0.0, 0.0)
        for each in (status, msgspec.structs.replace(status, reason="finished"))
    ]
    assert [row.note for row in rows] == [status.reason, ""]
    assert status.reason in table(rows, film.stage)
    assert Condition.OUT in (set(RINGED) & set(PALED))


@pytest.mark.slow
def test_positions_are_those_of_the_recording(recorded_case, film):
    trace, _ = recorded_case
    assert film.trace.robots == trace.robots
    for k in range(0, len(trace.time), 17):
        moment = film.moment(float(trace.time[k]))
        assert np.cos(moment.yaw - trace.yaw[k]) == pytest.approx(1.0, abs=1e-3)
        place = np.stack([moment.position, moment.goal])
        assert place == pytest.approx(np.stack([trace.true_position[k], trace.goal[k]]), abs=1e-6)
    between = float(trace.time[20] + trace.time[21]) / 2
    middle = (trace.true_position[20] + trace.true_position[21]) / 2
    assert film.moment(between).position == pytest.approx(middle, abs=1e-6)
    lost = replace(
        film.trace, true_position=np.where(film.trace.time[:, None, None] > 1.0, np.nan, film.trace.true_position)
    )
    silent = Film(replace(film.recording, trace=lost)).moment(2.5)
    assert silent.position == pytest.approx(film.moment(1.0).position, abs=1e-6)  # where they were last
    assert set(silent.condition.tolist()) == {Condition.LOST}


def test_truncated_recording_is_replayed_to_its_end(recorded_case, tmp_path):
    _, file = recorded_case
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: int(0.7 * file.stat().st_size)])
    assert 0.0 < Film(read_whole(cut)).end < Film(read_whole(file)).end
    cut.write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        read_whole(cut)


def test_conditions_and_errors_follow_the_phases(film):
    assert (film.moment(1.0).condition == Condition.ACTIVE).all()
    assert (film.moment(film.begin - 1.0).condition == Condition.WAITING).all()
    assert set(film.moment(film.end).condition.tolist()) <= {Condition.LANDING, Condition.DONE}
    assert "landing" in [mark[1] for mark in marks([film]) if isinstance(mark, tuple)]
    history = film.history()
    k = int(np.searchsorted(history.time, 2.0))
    error = film.links.of_robots(film.moment(history.time[k]).error)
    assert history.error[k] == pytest.approx(error, abs=1e-6, nan_ok=True)
    assert sum(rate.sum() for rate in history.rate) > 0


def test_the_clock_plays_pauses_and_ends():
    clock = ReplayClock(-2.0, 10.0)
    clock.advance(1.0)
    assert clock.t == 0.0
    clock.toggle()
    clock.speed = 5.0
    for seconds, found in ((1.0, (5.0, True)), (3.0, (10.0, False))):
        clock.advance(seconds)
        assert (clock.t, clock.playing) == found
    clock.toggle()
    assert (clock.t, clock.playing) == (-2.0, True)
    clock.loop = True
    clock.seek(99.0)
    clock.advance(1.0)
    assert (clock.t, clock.playing) == (-2.0, True)


def test_table_has_recorded_content_and_no_empty_columns(film):
    assert {(row.battery, row.late) for t in (0.0, film.end) for row in film.rows(t)} == {(None, None)}
    text = table(film.rows(film.end), film.stage)
    assert [word for word in ("f [Hz]", "battery", "missed", "delay", "nan", "None") if word in text] == ["f [Hz]"]
    first, *others = film.recording.statuses
    status = msgspec.structs.replace(first[0], stamp=1.0, battery=0.8, missed=3)
    trace = replace(film.trace, clock="real")
    real = Film(replace(film.recording, trace=trace, statuses=((status,), *others)))
    rows = [*real.rows(1.5)[:2], real.rows(0.5)[0]]
    assert [(row.battery, row.late) for row in rows] == [(0.8, 3), (None, None), (None, None)]
    text = table(real.rows(1.5), real.stage)
    assert [word for word in ("battery", ">80 %<") if word in text] == ["battery", ">80 %<"]


def test_curves_of_many_robots_are_three():
    history = History(40)
    for t in range(60):
        history.add(float(t), np.arange(40.0), np.zeros(40))
    time, *curves = history.curves(history.error)
    assert (time[0], time[-1], len(time), [curve[0] for curve in curves]) == (-30.0, 0.0, 31, [39.0, 19.5, 0.0])


def test_table_shows_the_worst_first_and_escapes_names(film):
    stage = film.stage
    rows = [RobotRow(f"R{k}", Condition.ACTIVE, error=0.001 * k) for k in range(30)]
    rows[3] = RobotRow("<b>", Condition.LOST, note="<script>", measures={"<i>": 0.12345})
    text = table(rows, stage)
    assert text.index("&lt;b&gt;") < text.index("R29") < text.index("R28")
    assert [part in text for part in ("&lt;i&gt;", "and 10 more", "<script>", " R10<")] == [True, True, False, False]
    assert "none yet" in event_list([], None)
    error = np.linspace(0.0, 0.1, len(stage.links))
    links = link_table(stage, error, [0.0123] * len(error))
    assert links.index("10.0 cm") < links.index("0.0 cm")
    assert "12.3 ms" in links


def test_warnings_misses_and_leaders_look_so(film):
    leader, follower, *_ = sorted(film.stage.names, key=lambda name: name != "TB01")
    late = {"error": 0.01, "late": 7, "late_share": 0.5, "note": "warn: a neighbour is lost"}
    rows = [RobotRow(leader, Condition.ACTIVE, late=0, delay=-1e-6), RobotRow(follower, Condition.ACTIVE, **late)]
    text = table(rows, film.stage)
    assert "-0.0" not in text
    for part in (">–<", f"color:{css(BAD)}'>50.0 %<", f"color:{css(FAIR)};padding-left:1.2em'>warn", ">0.0 %<"):
        assert part in text


def test_said_places_are_those_of_the_memory():
    run = recorded("aggregative", "duration_s=3.0", cases=("event",))
    trace, film = run.traces["event"], Film(read_whole(run.folder / "event.mcap"))
    assert dict(film.stage.place_variables) == {"s": 0}
    for k in range(5, len(trace.time), 31):
        moment = film.moment(float(trace.time[k]))
        wanted = np.column_stack([trace.memory["s"][k], moment.position[:, 2]])  # it says no z
        assert moment.places == pytest.approx(wanted[:, None], abs=1e-6)
    rows = film.rows(2.0)
    assert all(isfinite(each) for row in rows for each in row.measures.values())
    assert all(name in table(rows, film.stage) for name in list(trace.measures)[:3])


def test_places_with_z_and_unknown_ones():
    stage = SceneModel.of_plan(load("aggregative", "duration_s=3.0").cases()["event"])
    position = np.full((len(stage.names), 3), 0.7)
    said = [(1.0, 2.0, 3.0), (1.0, 2.0), (1.0, 2.0, 3.0, 4.0), (1.0,)]
    places = stage.said_places([*({"s": each} for each in said), {}], position)[:, 0]
    assert places[:3].tolist() == [[1.0, 2.0, 3.0], [1.0, 2.0, 0.7], [1.0, 2.0, 0.7]]
    assert np.isnan(places[3:]).all()
    assert not SceneModel.of_robots(("A",)).place_variables
    planned = SceneModel.of_plan(load("mpc", "duration_s=3.0").cases()["event"])
    path = tuple(float(number) for number in range(32))
    assert planned.said_places([{"path": path}], position)[0].tolist() == [[30.0, 31.0, 0.7]]


def test_a_mark_is_closed_and_looks_outward():
    mesh = models.diamond(0.03)
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normals, a + b + c) > 0.0).all()
    assert np.abs(normals.sum(axis=0)).max() < 1e-12
