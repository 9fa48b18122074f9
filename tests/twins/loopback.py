"""Protocol twins served by a thread, for the tests of devices and bridges."""

import select
import threading
import time
from dataclasses import replace

import numpy as np

from bridges.motion_capture.twin.capture import upright
from bridges.motion_capture.twin.vicon import ViconTwin
from twins.device import Capture, DeviceRequest, Faults


class Served:
    """A device in a thread: waits on its sockets and ticks it, as its own process would."""

    def __init__(self, factory, body, **faults):
        self._start(factory(DeviceRequest(body, Faults(**faults))), 1.0 / body.rate_hz)
        self.addresses = self.device.addresses

    def _start(self, device, period):
        self.device, self._period, self.zero = device, period, time.monotonic()
        self.lock, self._ending = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        due = time.monotonic()
        while not self._ending.is_set():
            ready, _, _ = select.select(self.device.sockets(), [], [], max(0.0, due - time.monotonic()))
            with self.lock:
                now = time.monotonic()
                for wire in ready:
                    if wire in self.device.sockets():
                        self.device.serve(wire, now - self.zero)
                if now >= due:
                    self.advance(now - self.zero)
                    due = max(due + self._period, now - 0.1)

    def advance(self, t):
        self.device.advance(t)

    def truth(self):
        with self.lock:
            return self.device.truth()

    def captured(self, **faults):
        """Poses that motion capture measures with these faults, for `Driver.truth`."""
        capture, wrong = Capture(), Faults(**faults)

        def told():
            position, yaw, turn = capture.measured(wrong, time.monotonic() - self.zero, *self.truth())
            return position, yaw + turn

        return told

    def kill(self):
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join()
            self.device.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()


class Camera(Served):
    """A Vicon twin; `look` is called before each frame and may place subjects in `twin`."""

    def __init__(self, subjects, *, look=lambda: None, **settings):
        self._rows = {name: row for row, name in enumerate(subjects)}
        self.twin = ViconTwin(subjects, **settings)
        self.port = int(self.twin.address.rpartition(":")[2])
        self._look = look
        self._start(self.twin, 0.002)

    def advance(self, t):
        self._look()
        self.twin.advance(t)

    def place(self, subject, position, yaw=0.0):
        with self.lock:
            self.twin.place(self._rows[subject], np.array(position, dtype=float), upright(yaw))

    def occlude(self, seconds):
        """From now on, and for so long, nothing is seen."""
        with self.lock:
            self.twin.link.faults = Faults(occluded_from_s=time.monotonic() - self.zero, occluded_for_s=seconds)


def reached(body, addresses):
    """The same request for the bridge, at the addresses that the device gave out."""
    return replace(body, addresses=tuple(addresses))
