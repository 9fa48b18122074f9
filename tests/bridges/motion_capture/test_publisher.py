"""The bridge of motion capture: what it believes, what it says, what it survives; and what robots make of it."""

import math
import socket
import threading
import time
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.capture_reader import CaptureFrame, MeasuredPose, parse_server
from agents.body.coordinates import yaw_of
from agents.clock import StampAge
from agents.network import messages, pubsub
from agents.network import session as network
from bridges.motion_capture.protocol import vicon_datastream
from bridges.motion_capture.publisher import RATE_OFF, Bridge, PoseFilter, parse_maps
from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.vicon import ViconReader
from experiments.file import document
from tests.commands import python, started
from tests.system.lab import RobotProcess, Watcher
from tests.twins import loopback
from tests.waiting import PATIENCE_S, ManualClock, until

Camera = partial(loopback.Camera, sigma=1e-9)  # what repeats itself is not believed
UPRIGHT = tuple(upright(0.3).ravel().tolist())


def frame(number=1, *, latency=0.0, up="z", clock=math.nan, **poses):
    seen = {name: MeasuredPose(pose, UPRIGHT) if len(pose or ()) == 3 else pose for name, pose in poses.items()}
    return CaptureFrame(number, seen, latency, up, clock)


@pytest.fixture
def printed():
    return []


@contextmanager
def published(address, printed, **subjects):
    """Positions that a bridge in a thread publishes."""
    positions, end = [], threading.Event()
    pose_filter = PoseFilter(subjects, printed.append)
    bridge = Bridge(
        *parse_server(address, 801), pose_filter, positions.append, printed.append, connect=ViconReader, pause_s=0.05
    )
    thread = threading.Thread(target=bridge.run, args=(end.is_set,))
    thread.start()
    yield positions
    end.set()
    thread.join()


class Stream(ManualClock):
    """A reader of the DataStream and its clock: a frame every 10 ms, the same one again and again from `last` on."""

    def __init__(self, monkeypatch, printed, last=math.inf):
        super().__init__(5.0)
        self.number, self._last, self.published = 0, last, []
        self.wall_step = 0.0
        monkeypatch.setattr(time, "clock_gettime", lambda _: self.now)
        monkeypatch.setattr(time, "time", lambda: 1.8e9 + self.now + self.wall_step)
        pose_filter = PoseFilter({"CF01": "CF01"}, printed.append)
        self.bridge = Bridge(
            "nowhere", 1, pose_filter, self.publish, printed.append, connect=lambda *_: self, pause_s=0.0
        )

    def newest(self, _timeout):
        self.now += 0.01
        self.number += 1
        return frame(int(min(self.number, self._last)), CF01=(0.001 * self.number, 0.0, 0.5))

    def close(self): ...

    def publish(self, position):
        self.published.append((position.stamp, position.position[0]))


@pytest.mark.parametrize("step", [-1.0, 3.0])
def test_wall_clock_step_moves_no_position(monkeypatch, printed, step):
    stream = Stream(monkeypatch, printed)
    assert stream.bridge.run(lambda: stream.now > 6.0)
    stream.wall_step = step
    assert stream.bridge.run(lambda: stream.now > 7.0)
    stamps = [stamp for stamp, _ in stream.published]
    assert len(stamps) > 150
    np.testing.assert_allclose(np.diff(stamps), 0.01, atol=1e-6)
    assert stamps[-1] == pytest.approx(1.8e9 + stream.now, abs=1e-6)


def test_a_frame_that_repeats_its_number_is_none(monkeypatch, printed):
    stream = Stream(monkeypatch, printed, last=50)
    assert stream.bridge.run(lambda: any("no new frame" in line for line in printed))
    assert [len(stream.published), stream.published[49][1]] == [50, pytest.approx(0.05)]
    assert printed[-1].startswith("lost nowhere:1: no new frame for 2 s")


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1), st.floats(1.01, 3.0))
def test_heading_follows_the_nose_and_only_rotations(yaw, pitch, roll, scale):
    tilt = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    bank = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    turned = upright(yaw) @ tilt @ bank
    assert yaw_of(turned.ravel().tolist()) == pytest.approx(yaw, abs=1e-9)
    mirrored = turned * [1.0, 1.0, -1.0]
    for wrong in (turned * scale, turned / scale, mirrored, turned * np.nan, turned * 0.0, turned + np.inf):
        assert math.isnan(yaw_of(wrong.ravel().tolist()))


def test_what_was_not_seen_is_not_said(printed):
    pose_filter = PoseFilter({"CF01": "cf_1", "KH01": "kh_1"}, printed.append)
    nan = MeasuredPose((math.nan, 0.0, 0.0), UPRIGHT)
    flat = MeasuredPose((0.0, 0.0, 0.0), (0.0,) * 9)
    (first,) = pose_filter.filter_poses(
        frame(cf_1=(0.1, 0.2, 0.3), kh_1=None, other=(0.0, 0.0, 0.0), latency=0.004), 1.0
    )
    assert first == ("CF01", 0.996, (0.1, 0.2, 0.3), pytest.approx(0.3))
    for pose in (nan, flat, None):
        assert pose_filter.filter_poses(frame(cf_1=pose, kh_1=pose), 1.1) == []
    assert pose_filter.refused == 4
    assert printed == ["CF01 is seen as 'cf_1'", "KH01 is not seen: markers hidden, or body 'kh_1' is switched off"]
    pose_filter.filter_poses(frame(other=(0.0, 0.0, 0.0)), 1.6)
    assert printed[2:] == [
        "CF01: no body 'cf_1' (there are: other); name another: --map CF01=BODY, or `names`",
        "KH01: no body 'kh_1' (there are: other); name another: --map KH01=BODY, or `names`",
    ]


def test_jump_is_not_believed_until_it_lasts():
    pose_filter = PoseFilter({"CF01": "CF01"}, lambda _: None)
    left_out = []
    for tick in range(200):  # half a metre a second, with an excursion of one frame and one that stays
        x = 0.005 * tick + (1.0 if tick == 50 or tick >= 100 else 0.0)
        poses = pose_filter.filter_poses(frame(CF01=(x, 0.0, 1.0)), 0.01 * tick)
        assert [position[0] for _, _, position, _ in poses] in ([], [x])
        left_out += [] if poses else [tick]
    assert left_out == [50, *range(100, 121)]  # 1 m in 0.22 s a robot could just have flown
    assert pose_filter.refused == 22


def test_a_pose_that_repeats_itself_is_not_published(printed):
    pose_filter = PoseFilter({"CF01": "CF01"}, printed.append)
    published = [
        tick
        for tick in range(200)
        if pose_filter.filter_poses(frame(CF01=(0.001 * min(max(tick, 49), 150), 0.0, 1.0)), 0.01 * tick)
    ]
    assert published == [*range(30), *range(50, 180)]
    frozen = "CF01: the pose of 'CF01' repeats itself to the last bit: the motion capture is frozen"
    seen = "CF01 is seen as 'CF01'"
    assert printed == [seen, frozen, seen, frozen]


@pytest.mark.parametrize(
    ("rate_off", "grows", "waited"),
    [(0.0, 0.0, (0.0, 0.0)), (0.002, 0.0, (0.0, 0.001)), (0.0, 0.1, (0.9, 1.0)), (0.0, -0.1, (0.0, 0.0))],
)
def test_growing_queue_shows_by_frame_numbers(rate_off, grows, waited):
    """Ten seconds at 100 Hz of a server whose rate is a little off, with a queue that grows [s/s]."""
    queue, least, most = StampAge(RATE_OFF), *waited
    for number in range(1000):
        arrived = 7.0 + number * 0.01 * (1.0 + rate_off + grows)
        wait_s = queue.age(arrived, 0.01 * number)
    assert least <= wait_s <= most
    assert queue.age(arrived + 1.0, 0.05) == 0.0, "it was started again"


def test_overtaking_frames_and_false_axes_are_left_out(printed):
    pose_filter = PoseFilter({"CF01": "CF01"}, printed.append)
    assert len(pose_filter.filter_poses(frame(CF01=(0.0, 0.0, 1.0)), 1.00)) == 1
    assert pose_filter.filter_poses(frame(CF01=(0.0, 0.0, 1.0), latency=0.02), 1.01) == []  # measured before the last
    assert pose_filter.filter_poses(frame(CF01=(0.0, 0.0, 1.0), up="other"), 1.02) == []
    assert len(pose_filter.filter_poses(frame(CF01=(0.0, 0.0, 1.0)), 1.03)) == 1
    assert printed[1:] == [
        "no positions: neither the z axis nor the y axis of the system points up; change this in its options",
        "the z axis points up",
    ]


def test_an_axis_that_changes_ends_the_positions(printed):
    pose_filter = PoseFilter({"CF01": "CF01"}, printed.append)
    ups = "zzyyz"
    heard = [pose_filter.filter_poses(frame(CF01=(0.01 * k, 0.0, 1.0), up=up), 0.1 * k) for k, up in enumerate(ups)]
    assert [len(poses) for poses in heard] == [1, 1, 0, 0, 1]
    assert printed[1:] == [
        "no positions: the y axis points up now, not z: start this bridge again", "the z axis points up"
    ]  # fmt: skip


@pytest.mark.parametrize("wrong", [-10.0, 1e9, math.inf, -math.inf, math.nan])
def test_false_latencies_hide_no_other_pose(wrong):
    pose_filter, left_out = PoseFilter({"CF01": "CF01"}, lambda _: None), []
    for k in range(50):
        latency = wrong if k in {0, 20} else 0.004
        poses = pose_filter.filter_poses(frame(CF01=(0.001 * k, 0.0, 1.0), latency=latency), 0.01 * k)
        assert all(measured <= 0.01 * k for _, measured, *_ in poses)
        left_out += [] if poses else [k]
    assert set(left_out) <= {0, 20}


@pytest.mark.parametrize(("begin", "rate_hz"), [(2**32 - 20, 100.0), (7, 240.0), (7, 30.0)])
def test_numbers_that_wrap_and_another_rate_go_on(monkeypatch, printed, begin, rate_hz):
    """Frames of 100 Hz, from half a second on at another rate, by a clock that counts the frames as Vicon's does."""
    stream = Stream(monkeypatch, printed)
    numbers = iter(range(begin, begin + 1000))

    def newest(_timeout):
        period = 1.0 / (100.0 if stream.now < 5.5 else rate_hz)
        stream.now += period
        number = next(numbers) % 2**32
        return frame(number, CF01=(0.01 * stream.now, 0.0, 0.5), clock=number * period)

    stream.newest = newest
    assert stream.bridge.run(lambda: stream.now > 7.0)
    stamps = np.array([stamp for stamp, _ in stream.published])
    assert np.diff(stamps).max() < 0.13
    assert stamps[-1] == pytest.approx(1.8e9 + stream.now, abs=0.01)


def test_the_command_line_is_understood_or_refused():
    assert parse_server("vicon", 801) == ("vicon", 801)
    assert parse_server("10.0.0.7:8801", 801) == ("10.0.0.7", 8801)
    assert parse_maps(["CF01=cf_1", "KH01"]) == {"CF01": "cf_1", "KH01": "KH01"}
    for wrong in ("", ":801", "host:", "host:0", "host:99999", "host:x"):
        with pytest.raises(ValueError, match="neither HOST nor HOST:PORT"):
            parse_server(wrong, 801)
    for maps in (["=cf_1"], ["CF01="], ["CF01", "CF01=a"], ["CF01=a", "CF02=a"]):
        with pytest.raises(ValueError, match=r"neither ROBOT|another --map"):
            parse_maps(maps)


def test_positions_arrive_as_placed_and_when_measured(printed):
    begin = time.time()
    with Camera(["cf_1", "KH01"], rate_hz=200.0) as camera:
        camera.place("cf_1", [0.123456789, -0.5, 1.0], 0.3)
        camera.place("KH01", [-1.0, 0.25, 0.06], -2.0)
        camera.twin.latency_s = 0.25
        with published(camera.twin.address, printed, CF01="cf_1", KH01="KH01") as positions:
            until(lambda: len(positions) > 60)
    now = time.time()
    drone, rover = ([each for each in positions if each.robot == robot] for robot in ("CF01", "KH01"))
    np.testing.assert_allclose([each.position for each in drone], len(drone) * [(0.123456789, -0.5, 1.0)])
    np.testing.assert_allclose([each.yaw for each in rover], -2.0)
    stamps = np.array([each.stamp for each in drone])
    assert np.diff(stamps).min() > 0.0
    assert np.median(np.diff(stamps)) > 0.8 * 0.005  # a busy machine leaves out some frames of the camera
    assert begin < stamps[0] + 0.25
    assert stamps[-1] + 0.25 < now + 0.01
    said = [
        line for line in printed if "wait in a queue" not in line and "frames/s" not in line
    ]  # a busy machine has them
    assert said == [f"connected to {camera.twin.address}", "CF01 is seen as 'cf_1'", "KH01 is seen as 'KH01'"]


def test_lost_server_and_nonsense_server_are_survived(printed):
    def said(words, times=1):
        until(lambda: sum(words in line for line in printed) >= times, f"{words!r} in {printed}")

    offer = vicon_datastream.pack_kinds(vicon_datastream.POSES)
    good = vicon_datastream.packet(vicon_datastream.pack_frame_number(1))
    with ExitStack() as stack:
        camera = stack.enter_context(Camera(["CF01"]))
        camera.place("CF01", [0.0, 0.0, 1.0])
        port = camera.port
        positions = stack.enter_context(published(camera.twin.address, printed, CF01="CF01"))
        until(lambda: len(positions) > 20)
        camera.occlude(math.inf)
        said("CF01 is not seen")
        camera.occlude(0.0)
        said("CF01 is seen", 2)
        camera.kill()
        said(f"lost {camera.twin.address}")
        for nonsense, words in (
            (b"HTTP/1.1 400 Bad Request\r\n\r\n", "a packet begins with 0x50545448"),
            (vicon_datastream.pack_kinds([1]), "no segments to offer"),
            (offer + good[:-3] + b"\x00" * 40, "a packet begins with"),
            (offer + vicon_datastream.packet(vicon_datastream.block(9, b"\x01")), "cut off"),
            (offer + vicon_datastream.block(vicon_datastream.MAGIC, b"\x05\x00\x00\x00\xff\xff\xff\xff"), "a block of"),
        ):
            with socket.create_server(("127.0.0.1", port)) as server:
                server.settimeout(PATIENCE_S)
                client, _ = server.accept()
                with client:
                    client.sendall(nonsense)
                    said(words)
        before = len(positions)
        back = stack.enter_context(Camera(["CF01"], port=port))
        back.place("CF01", [0.0, 0.0, 1.5])
        until(lambda: len(positions) > before + 20)
    assert {round(each.position[2], 6) for each in positions[:before]} == {1.0}
    assert {round(each.position[2], 6) for each in positions[before:]} == {1.5}


@pytest.mark.system
def test_a_wrong_host_is_said_and_ends_it(router):
    def said(server):
        words = (
            "-m",
            "bridges.motion_capture.publisher",
            "vicon",
            server,
            "--map",
            "CF01",
            "--connect",
            router.endpoint,
        )
        return python(*words, code=2).stderr

    assert said("127.0.0.1:vicon").startswith("zenpark: '127.0.0.1:vicon' is neither HOST nor HOST:PORT, such as 192.")
    silent = said("127.0.0.1:9")
    assert silent.startswith("vicon: no connection to 127.0.0.1:9: Connection refused; trying again")
    assert "no answer from 127.0.0.1:9 in 5 s" in silent
    assert "firewall let TCP port" in silent


@pytest.mark.mechanism("motion capture: occlusion")
@pytest.mark.system
def test_short_occlusion_is_flown_through_long_one_lands(router, tmp_path):
    """The whole way round: simulated bodies, a Vicon that sees them, its stream, the bridge, the robots' process."""
    file = tmp_path / "seen.toml"
    text = document.read("triangle").text.replace("hover = 0.6", 'hover = 0.3\nposition = "external"')
    file.write_text(text, encoding="utf-8")
    heights = [0.0]

    def look():
        for sample in network.received(states.handler):
            state = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.State)
            assert state.true_position is not None
            heights.append(state.true_position[2])
            camera.twin.place(0, np.array(state.true_position), upright(state.true_yaw or 0.0))

    with ExitStack() as stack:
        watcher = stack.enter_context(Watcher(router.endpoint))
        states = pubsub.subscriber(watcher.session, watcher.keys.state("CF01"), 64)
        camera = Camera(["CF01"], look=look)
        camera.place("CF01", [0.1, 0.6, 0.0])
        stack.enter_context(camera)
        words = ("--map", "CF01", "--lifeline", "--connect", router.endpoint)
        bridge = stack.enter_context(
            started("-m", "bridges.motion_capture.publisher", "vicon", camera.twin.address, *words, stderr=None)
        )
        robots = stack.enter_context(RobotProcess(router.endpoint, file, "KH01", "KH02", "CF01"))
        watcher.take_off("CF01")
        camera.occlude(0.3)
        flown = len(heights)
        watcher.until(lambda: len(heights) > flown + 50, "a second passes")
        assert watcher.phase("CF01") == "airborne"
        assert min(heights[flown:]) > 0.25
        camera.occlude(5.0)
        watcher.until(lambda: watcher.phase("CF01") == "done", "it is down")
        assert watcher.status["CF01"].reason == "its own position is lost"
        assert watcher.phase("KH01") == "ready"
        watcher.until(lambda: heights[-1] < 0.03, "it is on the ground")
        robots.end()
        bridge.stdin.close()
        assert bridge.wait(100.0) == 0, "it ends with its starter"
