"""VRPN by the client of the library `motioncapture`: a server, a body that is hidden, a child that hangs or dies.

The server speaks VRPN 07.35 as published: the client asks by UDP for a connection over TCP; cookies; names of senders
and types; reports of poses.
"""

import os
import signal
import socket
import struct
import threading
import time
from contextlib import closing, contextmanager
from itertools import count
from math import cos, isnan, sin

import pytest

from agents.body.coordinates import Coordinates
from bridges.motion_capture.publisher import PoseFilter
from bridges.motion_capture.vrpn import VrpnReader
from tests.waiting import PATIENCE_S, until

pytest.importorskip("motioncapture", reason="the reader of VRPN is the extra [vrpn]: ./zenpark install motioncapture")

COOKIE = b"vrpn: ver. 07.35  0".ljust(24, b"\0")
SENDER, TYPE = -1, -2  # kinds of the messages that name senders and types
BODIES = ("VRPN Control", "cart", "wand")
SHOWN = 50  # reports of the wand


def message(kind, sender, payload):
    head = struct.pack(">6i", 24 + len(payload), 0, 0, sender, kind, 0)
    return head + payload.ljust(-(-len(payload) // 8) * 8, b"\0")


def name(kind, number, text):
    return message(kind, number, struct.pack(">i", len(text) + 1) + text.encode() + b"\0")


def report(sender, x, y, z, yaw):
    return message(0, sender, struct.pack(">2i7d", 0, 0, x, y, z, 0.0, 0.0, sin(0.5 * yaw), cos(0.5 * yaw)))


@contextmanager
def streaming():
    """A server with a cart and a wand that is hidden after a second; 50 reports of each in a second."""
    over = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.bind(("127.0.0.1", 0))
        asked.settimeout(PATIENCE_S)

        def serve():
            host, port = asked.recv(1024).rstrip(b"\0").split()
            with socket.create_connection((host.decode(), int(port)), PATIENCE_S) as client:
                names = [name(SENDER, number, body) for number, body in enumerate(BODIES)]
                client.sendall(b"".join([COOKIE, *names, name(TYPE, 0, "vrpn_Tracker Pos_Quat")]))
                for number in count():
                    poses = report(1, 0.5, -0.25, 0.1 + 1e-6 * (number % 7), 0.4)
                    if number < SHOWN:
                        poses += report(2, 1.0, 2.0, 3.0 + 1e-6 * (number % 7), 0.0)
                    try:
                        client.sendall(poses)
                    except OSError:  # the child is gone
                        return
                    if over.wait(0.02):
                        return

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield asked.getsockname()
        finally:
            over.set()
            thread.join()


def test_frames_come_from_a_child():
    printed = []
    with streaming() as (host, port), closing(VrpnReader(host, port, PATIENCE_S)) as reader:
        pose_filter = PoseFilter({"KH01": "cart", "CF01": "wand"}, printed.append, Coordinates(), up="z")
        frames, published = [], []

        def heard():
            if (frame := reader.newest(0.2)) is not None and "wand" in frame.poses:
                frames.append(frame)
                published.append(pose_filter.filter_poses(frame, time.monotonic()))
            return "CF01 is not seen: markers hidden, or body 'wand' is switched off" in printed

        until(heard)
    one, other = frames[:2]
    assert other.number == one.number + 1
    assert isnan(other.latency_s), "the library does not say it"
    assert other.poses["cart"].position == pytest.approx((0.5, -0.25, 0.1), abs=1e-5)
    assert other.poses["cart"].rotation[:4:3] == pytest.approx((cos(0.4), sin(0.4)), abs=1e-5)
    (last,) = published[-1]
    assert (last[0], last[3]) == ("KH01", pytest.approx(0.4, abs=1e-5))


def test_a_child_that_hangs_or_dies_is_noticed():
    with streaming() as (host, port), closing(VrpnReader(host, port, PATIENCE_S)) as reader:
        os.kill(reader._child.pid, signal.SIGSTOP)
        until(lambda: reader.newest(0.1) is None)
        os.kill(reader._child.pid, signal.SIGKILL)
        with pytest.raises(ConnectionResetError, match=r"has ended \(-9\)"):
            reader.newest(PATIENCE_S)
    assert reader._child.returncode == -signal.SIGKILL


def test_no_answer_ends_the_child():
    with pytest.raises(OSError, match=r"no answer|has ended"):
        VrpnReader("127.0.0.1", 9, 0.5)
