"""A system by the library `motioncapture` in a child: frames, and a child that hangs, dies or gets no answer."""

import os
import select
import signal
import threading
from contextlib import closing, contextmanager
from math import cos, isnan, sin

import numpy as np
import pytest

from bridges.motion_capture.publisher import PoseFilter
from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.twin.vicon import ViconTwin
from bridges.motion_capture.vrpn import VrpnReader
from tests.waiting import PATIENCE_S, until

pytest.importorskip("motioncapture", reason="the reader of VRPN is the extra [vrpn]: ./zenpark install motioncapture")


class ByLibrary(VrpnReader):
    """The library has no VRPN server; its client of Vicon reads our twin."""

    SYSTEM = "vicon"


@contextmanager
def streaming():
    """A twin with a body, 50 frames/s."""
    twin, over = ViconTwin(["cart"]), threading.Event()

    def serve():
        number = 0
        while not over.is_set():
            for ready in select.select(twin.sockets(), [], [], 0.005)[0]:
                twin.serve(ready, 0.01 * number)
            number += 1
            twin.place(0, np.array([0.5, -0.25, 0.1 + 1e-6 * (number % 7)]), upright(0.4))
            twin.advance(0.01 * number)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        host, port = twin.address.split(":")
        yield host, int(port)
    finally:
        over.set()
        thread.join()
        twin.close()


def test_frames_come_from_a_child():
    with streaming() as (host, port), closing(ByLibrary(host, port, PATIENCE_S)) as reader:
        frames = []
        until(lambda: frames.append(reader.newest(0.2)) or len([each for each in frames if each]) > 3)
        one, other = [each for each in frames if each][-2:]
        assert other.number == one.number + 1
        assert isnan(other.latency_s), "the library does not say it"
        assert other.poses["cart"].position == pytest.approx((0.5, -0.25, 0.1), abs=1e-4)
        assert other.poses["cart"].rotation[:4:3] == pytest.approx((cos(0.4), sin(0.4)), abs=1e-5)
        filtered = PoseFilter({"KH01": "cart"}, print, up="z").filter_poses(other, 1.0)
        assert filtered[0][3] == pytest.approx(0.4, abs=1e-5)


def test_a_child_that_hangs_or_dies_is_noticed():
    with streaming() as (host, port), closing(ByLibrary(host, port, PATIENCE_S)) as reader:
        os.kill(reader._child.pid, signal.SIGSTOP)
        until(lambda: reader.newest(0.1) is None)
        os.kill(reader._child.pid, signal.SIGKILL)
        with pytest.raises(ConnectionResetError, match=r"has ended \(-9\)"):
            reader.newest(PATIENCE_S)
    assert reader._child.returncode == -signal.SIGKILL


def test_no_answer_ends_the_child():
    with pytest.raises(OSError, match=r"no answer|has ended"):
        VrpnReader("127.0.0.1", 9, 0.5)
