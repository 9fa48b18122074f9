"""The Vicon twin: what the vendor's own client and ours read from it, and what it does when things go wrong."""

import json
import math
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from bridges.motion_capture.protocol import vicon_datastream
from bridges.motion_capture.protocol.vicon_datastream import BlockKind, Segment
from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.twin.vicon import ViconTwin
from bridges.motion_capture.vicon import Decoder, ViconReader
from tests.commands import python, started
from tests.twins.loopback import Camera
from tests.waiting import until
from twins.device import Faults

# the vendor's client, in a process of its own: it holds the interpreter, and never returns from a dead server
VENDOR = """
import json, os, sys
import motioncapture
vicon = motioncapture.connect("vicon", {"hostname": sys.argv[1]})
for _ in range(10):
    vicon.waitForNextFrame()
bodies = vicon.rigidBodies
print(json.dumps({name: [*map(float, body.position), *(getattr(body.rotation, part) for part in "wxyz")]
                  for name, body in bodies.items()}), flush=True)
os._exit(0)
"""


def read(port, frames=1):
    with closing(ViconReader("127.0.0.1", port)) as reader:
        found = [reader.newest(2.0) for _ in range(frames)]
    assert None not in found
    return found


finite = st.floats(-50.0, 50.0)
bodies = st.lists(st.tuples(finite, finite, finite, st.lists(finite, min_size=9, max_size=9)), max_size=5)


@given(bodies, st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_packed_frames_are_unpacked_however_they_are_cut(bodies, number, cut):
    sent = [Segment(0, (x, y, z), tuple(turn)) for x, y, z, turn in bodies]
    stream = vicon_datastream.packet(
        vicon_datastream.pack_axes(),
        *(vicon_datastream.pack_subject(row, f"körper {row}") for row in range(len(sent))),
        vicon_datastream.pack_frame_number(number),
        vicon_datastream.pack_latency([("a", 0.25), ("b", 1.125)]),
        *(vicon_datastream.pack_segments(row, [segment]) for row, segment in enumerate(sent)),
    )
    framer, decoder = vicon_datastream.framer(), Decoder()
    packets = [body for at in range(0, 2 * len(stream), cut) for _, body in framer.feed((stream * 2)[at : at + cut])]
    assert len(packets) == 2
    for body in packets:
        frame = decoder.frame(body)
        assert (frame.number, frame.latency_s, frame.up) == (number, 1.375, "z")
        assert list(frame.poses) == [f"körper {row}" for row in range(len(sent))]
        for seen, placed in zip(frame.poses.values(), sent, strict=True):
            assert seen.position == pytest.approx(placed.position, abs=1e-12)
            assert seen.rotation == placed.rotation


def test_root_segment_is_subject_pose_and_names_update():
    def subject(number, name, segments):
        parts = [struct.pack("<II24xI4s", parent, segment, 4, b"part") for parent, segment in segments]
        payload = struct.pack(f"<II{len(name)}sI", number, len(name), name.encode(), len(parts)) + b"".join(parts)
        return vicon_datastream.block(BlockKind.SUBJECT_INFO, payload + bytes(8))

    near, far = Segment(7, (1.0, 0.0, 0.0), (0.0,) * 9), Segment(3, (2.0, 0.0, 0.0), (0.0,) * 9)
    moved = vicon_datastream.pack_frame_number(5) + vicon_datastream.pack_segments(1, [near, far])
    decoder = Decoder()
    root = vicon_datastream.NO_PARENT
    assert decoder.frame(subject(1, "arm", [(root, 3), (3, 7)]) + subject(2, "leg", [(root, 0)])) is None
    assert decoder.frame(moved).poses == {"arm": far[1:], "leg": None}
    assert decoder.frame(subject(1, "hand", [(7, 3), (root, 7)]) + moved).poses == {"hand": near[1:]}


@pytest.mark.system
@pytest.mark.skipif(find_spec("motioncapture") is None, reason="needs motioncapture, the vendor's client in a wheel")
def test_vendors_client_and_ours_read_same_poses():
    placed = {"level": ([0.0, 2.0, 1.5], 0.0), "turned": ([0.123456789, -1.987654321, 0.314159265], 1.2)}
    with Camera(list(placed)) as camera:
        for name, (position, yaw) in placed.items():
            camera.place(name, position, yaw)
        (frame,) = read(camera.port)
        command = [sys.executable, "-c", VENDOR, camera.twin.address]
        vendor = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    theirs = json.loads(vendor.stdout)
    assert theirs.keys() == frame.poses.keys() == placed.keys()
    for name, (position, yaw) in placed.items():
        ours = [*frame.poses[name]]
        assert ours == [pytest.approx(position, abs=1e-12), pytest.approx(upright(yaw).ravel(), abs=1e-12)]
        # that wheel hands out single precision: to the last bit of it they are the same
        np.testing.assert_array_equal(np.float32(theirs[name][:3]), np.float32(ours[0]))
        assert theirs[name][3:] == pytest.approx([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], abs=3e-7)


@pytest.mark.system
def test_slow_and_rude_clients_block_nobody():
    with Camera(["CF01"], rate_hz=250.0) as camera:
        camera.place("CF01", [0.1, 0.2, 0.3], 0.5)
        slow, rude = (socket.create_connection(("127.0.0.1", camera.port), 2.0) for _ in range(2))
        with slow, rude, rude.makefile("rb") as heard:
            slow.sendall(vicon_datastream.packet(vicon_datastream.block(BlockKind.REQUEST_FRAME, b"\x01")))
            rude.sendall(b"GET / HTTP/1.1\r\n\r\n")
            numbers = [frame.number for frame in read(camera.port, 20)]
            assert numbers == sorted(set(numbers))
            assert numbers[-1] - numbers[0] < 60
            # it gets what there is, and is then left
            assert heard.read() == vicon_datastream.pack_kinds(vicon_datastream.POSES)


@contextmanager
def viewer(subjects=("CF01",), **settings):
    with closing(ViconTwin(subjects, **settings)) as twin, closing(Viewer(twin)) as made:
        yield made


class Viewer:
    def __init__(self, twin):
        self.twin = twin
        self.client = socket.create_connection(("127.0.0.1", int(self.twin.address.rpartition(":")[2])), 2.0)
        self.framer, self.decoder, self.close = vicon_datastream.framer(), Decoder(), self.client.close
        self.serve()
        self.ask(BlockKind.REQUEST_FRAME, b"\x01")
        assert self.client.recv(65536) == vicon_datastream.pack_kinds(vicon_datastream.POSES)

    def serve(self):
        for ready in select.select(self.twin.sockets(), [], [], 2.0)[0]:
            self.twin.serve(ready, 0.0)

    def ask(self, *words):
        self.client.sendall(vicon_datastream.packet(vicon_datastream.block(*words)))
        self.serve()

    def frames(self, t):
        """Frames that arrive when it is `t` [s]."""
        self.twin.advance(t)
        if not select.select([self.client], [], [], 0.02)[0]:
            return []
        return [self.decoder.frame(body) for _, body in self.framer.feed(self.client.recv(65536))]


def test_delayed_frame_comes_late_but_unchanged():
    with viewer(faults=Faults(delay_s=0.05)) as seen:
        for t, height in ((0.01, 1.0), (0.02, 2.0), (0.055, 3.0)):
            seen.twin.place(0, np.array([0.0, 0.0, height]), upright(0.0))
            assert seen.frames(t) == []
        (frame,) = seen.frames(0.061)
    assert (frame.number, frame.poses["CF01"].position) == (1, (0.0, 0.0, 1.0))


def test_occlusion_silence_and_noise_are_as_specified():
    faults = Faults(occluded_from_s=0.805, occluded_for_s=0.1, silent_from_s=0.955)
    with viewer(sigma=0.001, faults=faults) as made:
        made.twin.place(0, np.array([0.3, -0.3, 1.0]), upright(0.0))
        frames = [frame for tick in range(1, 100) for frame in made.frames(0.01 * tick)]
    seen = [frame.poses["CF01"] for frame in frames]
    assert [frame.number for frame in frames] == list(range(1, 96))
    assert [k + 1 for k, pose in enumerate(seen) if pose is None] == list(range(81, 91))
    error = np.array([pose.position for pose in seen if pose is not None]) - [0.3, -0.3, 1.0]
    assert error.std(axis=0) == pytest.approx([0.001] * 3, rel=0.25)


def test_a_client_may_ask_for_single_frames():
    with viewer() as made:
        made.ask(BlockKind.REQUEST_FRAME, b"\x00")
        assert [len(made.frames(t)) for t in (0.01, 0.02)] == [1, 0]
        made.ask(BlockKind.REQUEST_NEXT_FRAME)
        assert [len(made.frames(t)) for t in (0.03, 0.04)] == [1, 0]


@pytest.fixture
def process(router, request):
    """Process of the twin; a parameter is a list of more options."""
    words = ["vicon", "CF01", "KH01", "--connect", router.endpoint, "--sigma", "0", "--rate", "200"]
    with started("-m", "bridges.motion_capture.twin.capture", *words, *getattr(request, "param", [])) as made:
        yield made


@pytest.mark.system
def test_the_process_shows_the_truth_that_it_hears(process, router):
    said = process.stdout.readline()
    assert said.startswith("vicon ready on 127.0.0.1:")
    keys = Keys()
    with network.open_session([router.endpoint], name="test") as session:
        truth = pubsub.publisher(session, keys.truth("CF01"), messages.JSON)
        reader = ViconReader("127.0.0.1", int(said.rpartition(":")[2]))
        seen = None
        while seen is None:
            truth.put(messages.encode(messages.Position("CF01", time.time() - 0.02, (0.4, -0.2, 0.9), 0.7)))
            session.put(keys.truth("KH01"), b"{}", encoding=messages.JSON)
            frame = reader.newest(1.0)
            assert frame.poses["KH01"] is None
            seen = frame.poses["CF01"]
        assert seen.position == pytest.approx((0.4, -0.2, 0.9), abs=1e-12)
        assert np.arctan2(seen.rotation[3], seen.rotation[0]) == pytest.approx(0.7, abs=1e-12)
        assert 0.02 <= frame.latency_s < 0.3
        until(lambda: reader.newest(1.0).poses["CF01"] is None, "silence is no place")
        reader.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(100.0) == 0


@pytest.mark.mechanism("lifeline: motion capture stays until the robots are down")
@pytest.mark.parametrize("process", [["--lifeline"]], indirect=True)
@pytest.mark.system
def test_process_ends_with_its_starter_after_the_robots(process, router):
    said = process.stdout.readline()
    reader = ViconReader("127.0.0.1", int(said.rpartition(":")[2]))
    with network.open_session([router.endpoint], name="robot") as session:
        token = pubsub.alive_token(session, Keys().alive("KH01"))
        process.stdin.close()
        for _ in range(40):
            assert reader.newest(1.0) is not None
        assert process.poll() is None
        token.undeclare()
        assert process.wait(100.0) == 0
    reader.close()


@pytest.mark.system
@pytest.mark.parametrize(
    ("option", "value", "words"), [("--listen", "801", "is not HOST:PORT"), ("--rate", "0", ">= 1")]
)
def test_user_errors_are_reported_without_a_traceback(option, value, words):
    command = ["-m", "bridges.motion_capture.twin.capture", "vicon", "CF01", "--connect", "tcp/127.0.0.1:9"]
    ended = python(*command, option, value, code=2)
    assert words in ended.stderr
    assert "Traceback" not in ended.stderr


def told(fault, size=0.0):
    frames = []
    with viewer(["CF01", "CF02"], sigma=0.001) as made:
        for k in range(1, 7):
            made.twin.link.faults = Faults(capture=fault if k > 3 else "", capture_by=size)
            for row in range(2):
                made.twin.place(row, np.array([0.1 * k, float(row), 0.5]), upright(0.0))
            frames += made.frames(0.01 * k)
    return frames[:3], frames[3:]


def test_frozen_repeated_swapped_and_renamed_captures():
    before, during = told("frozen")
    assert [(frame.number, frame.poses) for frame in during] == [(k, before[-1].poses) for k in (4, 5, 6)]
    before, during = told("repeated")
    assert during == [before[-1]] * 3
    before, during = told("swapped")
    found = [frame.poses[name].position[1] for frame in before + during for name in ("CF01", "CF02")]
    assert found == pytest.approx([0.0, 1.0] * 3 + [1.0, 0.0] * 3, abs=0.02)
    before, during = told("renamed")
    assert {tuple(frame.poses) for frame in before} == {("CF01", "CF02")}
    assert {tuple(frame.poses) for frame in during} == {("CF01-renamed", "CF02")}  # names are sent once more
    faults = Faults(capture="swapped", capture_from_s=2.0, capture_for_s=1.0)
    assert [faults.captured(t)[0] for t in (1.9, 2.0, 2.9, 3.0)] == ["", "swapped", "swapped", ""]


def test_late_turned_and_stuck_captures():
    before, during = told("late", 0.02)
    found = [frame.poses["CF01"].position[0] for frame in before + during]
    assert found == pytest.approx([0.1, 0.2, 0.3, 0.2, 0.3, 0.4], abs=0.01)
    before, during = told("turned", 0.5)
    sines = [frame.poses[name].rotation[3] for frame in (before[-1], during[-1]) for name in ("CF01", "CF02")]
    assert sines == pytest.approx([0.0, 0.0, np.sin(0.5), 0.0])
    before, during = told("stuck", 0.02)
    found = np.array([[frame.poses[name].position[0] for name in ("CF01", "CF02")] for frame in during])
    assert found[:, 1] == pytest.approx([0.4, 0.5, 0.6], abs=0.01)
    assert found[:, 0] == pytest.approx([0.4] * 3, abs=0.1)
    assert np.ptp(found[:, 0]) > 1e-3
