"""Readers of all motion capture systems against their twins, by a clock of the test: each fault, each system."""

import pkgutil
import select
import threading
import time
from contextlib import closing, contextmanager
from math import cos, dist, inf, nan, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.body.byte_stream import MalformedStream
from agents.body.capture_reader import rotation_of
from agents.body.coordinates import Coordinates
from agents.plugins import registry
from bridges.motion_capture.protocol import natnet, qtm
from bridges.motion_capture.protocol.natnet import NatNetFrame, RigidBodyPose
from bridges.motion_capture.protocol.qtm import BodyPose, QtmFrame
from bridges.motion_capture.publisher import Bridge, PoseFilter
from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.twin.optitrack import OptiTrackTwin, quaternion
from tests.waiting import ManualClock
from twins.device import Faults

ARENA = Coordinates(origin=(1.0, -2.0, 0.5), heading=0.7)
BODIES = {"CF01": "cf_1", "KH01": "Rigid Body 2"}
SYSTEMS = {
    "vicon": {},
    "qualisys": {},
    "optitrack": {"up": "z"},
    "optitrack 3.0, multicast": {"version": "3.0", "multicast": True},
}
BEGIN, LASTS = 0.5, 0.6  # begin and duration of a fault [s]


def true_pose(robot, t):
    """Position [m] and yaw [rad] in the arena."""
    return ((0.5 * cos(t), 0.5 * sin(t), 0.8), t) if robot == "CF01" else ((1.5, 0.1 * t, 0.06), 2.0 - 0.3 * t)


@contextmanager
def served(twin):
    """The server answers, and sends nothing by itself."""
    over = threading.Event()

    def serve():
        while not over.is_set():
            for ready in select.select(twin.sockets(), [], [], 0.01)[0]:
                twin.serve(ready, twin.link.t)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class Bench(ManualClock):
    """A twin, its reader and the bridge, a frame every 10 ms."""

    def __init__(self, monkeypatch, system, **faults):
        super().__init__(5.0)
        monkeypatch.setattr(time, "clock_gettime", lambda _: self.now)
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        monkeypatch.setattr(time, "time", lambda: 1.8e9 + self.now)
        self._system, self._settings = registry.load(registry.POSITIONING, system.split()[0]), SYSTEMS[system]
        self.printed, self.published, self.connections = [], [], 0
        self.at, self.event = inf, lambda: None  # what happens at a time of the server [s]
        self.begin(**faults)
        arena = replace(ARENA, up=self._settings.get("up"))
        pose_filter = PoseFilter(BODIES, self.printed.append, arena, up=self._system.UP)
        self.bridge = Bridge(
            "nowhere", 1, pose_filter, self._publish, self.printed.append, connect=self._connect, pause_s=0.0
        )

    def begin(self, port=0, **faults):
        """A new server, which counts from the begin."""
        settings = {**self._settings, "faults": Faults(**faults), "port": port}
        self.twin = pkgutil.resolve_name(self._system.TWIN)(list(BODIES.values()), **settings)
        self.started_at = self.now

    def run(self, until):
        """Run until this time of the server [s]."""
        try:
            assert self.bridge.run(lambda: self.now - self.started_at > until and self.at == inf)
        finally:
            self.twin.close()

    def times(self, robot, begin=0.0, end=inf):
        """Times of the published positions of a robot [s]; each is where the robot was."""
        found = [(stamp, position, yaw) for name, stamp, position, yaw in self.published if name == robot]
        assert [stamp for stamp, *_ in found] == sorted({stamp for stamp, *_ in found})
        for stamp, position, yaw in found:
            if BEGIN <= stamp <= BEGIN + 0.35 and self.said("to the last bit"):  # it takes 0.3 s to be noticed
                continue
            true, heading = true_pose(robot, stamp)
            assert dist(position, true) < 1e-5, stamp
            assert cos(yaw - heading) > 1.0 - 1e-9, stamp
        return [stamp for stamp, *_ in found if begin <= stamp < end]

    def said(self, words):
        return any(words in line for line in self.printed)

    def _connect(self, _host, _port, _timeout):
        host, port = self.twin.address.split(":")
        self.connections += 1
        assert self.connections < 200
        with served(self.twin):
            self.reader = self._system(host, int(port), 5.0)
        return self

    def newest(self, _timeout):
        self.now += 0.01
        if self.now - self.started_at >= self.at:
            self.at = inf
            self.event()
        self._advance(self.now - self.started_at)
        return self.reader.newest(0.0)

    def _advance(self, t):
        for row, robot in enumerate(BODIES):
            position, yaw = ARENA.measured(*true_pose(robot, t))
            self.twin.place(row, np.array(position), upright(yaw))
        for ready in select.select(self.twin.sockets(), [], [], 0.0)[0]:
            self.twin.serve(ready, t)
        self.twin.advance(t)

    def close(self):
        self.reader.close()

    def _publish(self, position):
        stamp = position.stamp - 1.8e9 - self.started_at
        self.published.append((position.robot, stamp, position.position, position.yaw))


@pytest.fixture(params=SYSTEMS)
def system(request):
    return request.param


def fault(name, lasts=LASTS):
    return {"capture": name, "capture_from_s": BEGIN, "capture_for_s": lasts}


ALL = ("CF01", "KH01")
NOT_SEEN = "is not seen"
FAULTS = {  # settings of the twin; robots without positions meanwhile; what is said
    "none": ({}, (), "frames/s"),
    "lost frames": ({"loss": 0.3}, (), "frames/s"),
    "silent": ({"silent_from_s": BEGIN, "silent_for_s": LASTS}, ALL, "is seen"),
    "occluded": ({"occluded_from_s": BEGIN, "occluded_for_s": LASTS}, ALL, NOT_SEEN),
    "frozen": (fault("frozen"), ALL, "repeats itself to the last bit"),
    "repeated": (fault("repeated"), ALL, "is seen"),
    "renamed": (fault("renamed", 1.6), ("CF01",), "no body 'cf_1'"),
    "missing": (fault("missing"), ("CF01",), NOT_SEEN),
    "overtaking": (fault("overtaking"), (), "is seen"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_of_each_system(monkeypatch, system, name):
    faults, hidden, words = FAULTS[name]
    bench = Bench(monkeypatch, system, **faults)
    end = BEGIN + faults.get("capture_for_s", LASTS)
    back = 1.2 if name == "renamed" else 0.6  # QTM is asked for names once a second
    bench.run(end + back + 0.3)
    if (system, name) == ("qualisys", "missing"):  # QTM names bodies by their order alone
        hidden = ALL
    for robot in ALL:
        assert len(bench.times(robot, 0.1, BEGIN)) > 20
        assert len(bench.times(robot, end + back)) > 15
        during = bench.times(robot, end - 0.25, end - 0.01)
        assert during == [] if robot in hidden else len(during) > 10, robot
    assert bench.said(words)
    assert bench.connections == 1


@pytest.mark.parametrize(("name", "size"), [("late", 0.1), ("turned", 0.5), ("stuck", 0.002)])
def test_faults_that_no_frame_shows_pass(monkeypatch, system, name, size):
    """Robots, preflight and hop notice these: the bridge gives what the system says, with its stamps."""
    bench = Bench(monkeypatch, system, **fault(name), capture_by=size)
    bench.run(BEGIN + LASTS + 0.1)
    during = {robot: [] for robot in ALL}
    for robot, stamp, position, yaw in bench.published:
        if BEGIN + 0.01 <= stamp < BEGIN + LASTS:
            during[robot].append((stamp, position, yaw))
    for robot in ALL:
        wrong = robot == "CF01" or name == "late"
        assert len(during[robot]) > 50
        for stamp, position, yaw in during[robot]:
            stuck = BEGIN if wrong else stamp
            true, heading = true_pose(robot, {"late": stamp - size, "turned": stamp, "stuck": stuck}[name])
            assert dist(position, true) < (6.0 * size if wrong and name == "stuck" else 1e-4)
            if name != "stuck":
                assert cos(yaw - heading - (size if wrong and name == "turned" else 0.0)) > 1.0 - 1e-8


def test_swapped_bodies_are_not_believed_at_once(monkeypatch, system):
    bench = Bench(monkeypatch, system, **fault("swapped"))
    bench.run(BEGIN + 0.2)
    for robot in ALL:
        assert len(bench.times(robot)) > 20
        assert bench.times(robot, BEGIN + 0.001) == []


def test_damaged_frames_end_no_bridge(monkeypatch, system):
    bench = Bench(monkeypatch, system, **fault("damaged"))
    bench.run(4.0)  # a damaged length of a packet leaves TCP silent for 2 s
    after = [stamp for _, stamp, *_ in bench.published if stamp > 3.6]
    assert len(after) > 30
    assert bench.said("lost nowhere:1") or system.startswith("optitrack")


def test_a_restarted_server_is_read_again(monkeypatch, system):
    """A server that is killed, and one that begins to count its frames again."""
    bench = Bench(monkeypatch, system)

    def start_again():
        assert len(bench.times("CF01")) > 50
        bench.twin.close()
        bench.published.clear()
        data_port = getattr(bench.twin, "_data_port", 0)
        bench.begin(int(bench.twin.address.split(":")[1]))
        bench.twin._data_port = data_port

    bench.at, bench.event = 1.0, start_again
    bench.run(1.5)
    assert len(bench.times("CF01", 0.7)) > 50


def test_lower_frame_numbers_are_a_new_stream(monkeypatch):
    bench = Bench(monkeypatch, "optitrack")

    def count_again():
        bench.twin.frames_sent = 0
        bench.started_at = bench.now
        bench.published.clear()

    bench.at, bench.event = 1.0, count_again
    bench.run(1.0)
    assert bench.connections == 1
    assert len(bench.times("CF01", 0.2)) > 50


def test_frames_of_another_server_are_dropped(monkeypatch):
    """A second laboratory in the same group."""
    bench = Bench(monkeypatch, "optitrack 3.0, multicast")
    with closing(OptiTrackTwin(["cf_1"], version="3.0", multicast=True, host="127.0.0.2")) as other:

        def interfere(t):
            other.place(0, np.array([0.0, 0.0, 1.0]), upright(0.0))
            other.advance(t)

        other._data_port = bench.twin._data_port
        advance, bench._advance = bench._advance, lambda t: (interfere(t), t < 1.0 and advance(t))
        bench.run(1.8)
    assert len(bench.times("CF01", 0.1)) > 50
    assert bench.said("frames come from 127.0.0.2: name that host, or end the other server")


def test_other_versions_and_servers_are_refused():
    info = natnet.ServerInfo("Motive", (4, 2), natnet.CLOCK_HZ, 1511, "")
    assert natnet.unpack_server_info(natnet.pack_server_info(info)) == info
    for other in (info._replace(version=(2, 10)), info._replace(version=(5, 0)), info._replace(clock_hz=0)):
        with pytest.raises(MalformedStream):
            natnet.unpack_server_info(natnet.pack_server_info(other))


finite = st.floats(-50.0, 50.0, width=32)
triples, fours = st.tuples(finite, finite, finite), st.tuples(finite, finite, finite, finite)
rigid_bodies = st.lists(st.builds(RigidBodyPose, st.integers(0, 2**31 - 1), triples, fours, st.booleans()), max_size=4)
versions = st.sampled_from([(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)])


@given(rigid_bodies, versions, st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1), st.integers(0, 7))
def test_natnet_frames_are_unpacked_as_packed(bodies, version, number, ticks, flags):
    frame = NatNetFrame(number, bodies, ticks, ticks, ticks, flags)
    assert natnet.unpack_frame(natnet.pack_frame(frame, version), version) == frame


@given(st.dictionaries(st.integers(0, 99), st.text(st.characters(codec="ascii", exclude_characters="\0"))), versions)
def test_natnet_names_are_unpacked_as_packed(names, version):
    assert natnet.unpack_descriptions(natnet.pack_descriptions(names, version), version) == list(names.items())


@given(st.lists(st.builds(BodyPose, triples, st.tuples(*[finite] * 9)), max_size=4), st.integers(1, 40))
def test_qtm_frames_are_unpacked_however_cut(bodies, cut):
    stream = qtm.pack_frame(QtmFrame(1.25, 7, bodies)) + qtm.command(b"text")
    framer = qtm.framer()
    (_, payload), text = [each for at in range(0, len(stream), cut) for each in framer.feed(stream[at : at + cut])]
    frame = qtm.unpack_frame(payload)
    assert (frame.time_s, frame.number, text) == (1.25, 7, (qtm.QtmPacketKind.COMMAND, b"text\0"))
    for read, sent in zip(frame.bodies, bodies, strict=True):
        assert read.position == pytest.approx(sent.position, abs=1e-5)
        assert read.rotation == sent.rotation


def test_parameters_with_entities_are_refused():
    with pytest.raises(MalformedStream, match="definitions"):
        qtm.unpack_parameters(b'<!DOCTYPE a [<!ENTITY b "c">]><a/>\0')


@given(st.floats(-pi, pi), st.floats(-1.4, 1.4), finite, st.floats(-3.0, 3.0), st.sampled_from(["y", "z"]))
def test_poses_come_back_from_coordinates(yaw, pitch, x, heading, up):
    tilt = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    arena = Coordinates(origin=(0.5, -0.25, 1.0), heading=heading)
    position, turned = arena.measured((x, 1.0, 2.0), yaw)
    twin = OptiTrackTwin.__new__(OptiTrackTwin)
    twin._up = up
    place, turn = twin._pose(np.array(position), upright(turned) @ tilt)
    found, measured = arena.placed(place, rotation_of(turn), up)
    assert found == pytest.approx((x, 1.0, 2.0), abs=1e-9)
    assert cos(measured - yaw) == pytest.approx(1.0, abs=1e-9)


def test_no_rotation_is_made_of_zeros():
    for wrong in ((0.0,) * 4, (0.0, 0.0, 0.0, 1.1), (nan, 0.0, 0.0, 1.0)):
        assert np.isnan(rotation_of(wrong)).all()
    assert rotation_of(quaternion(upright(1.0))) == pytest.approx(upright(1.0).ravel().tolist())
    flipped = np.diag([1.0, -1.0, -1.0])
    assert rotation_of(quaternion(flipped)) == pytest.approx(flipped.ravel().tolist())
