"""A Vicon twin served by a thread, for the tests of the twin and of the bridge."""

import select
import threading
import time

import numpy as np

from twins.devices.device import Faults
from twins.devices.vicon import ViconTwin, upright


class Camera:
    """`look` is asked before each frame and may place and hide subjects."""

    def __init__(self, subjects, *, look=None, port=0, **settings):
        faults = Faults(**settings.pop("faults", {}))
        self.twin = ViconTwin(subjects, faults=faults, port=port, **settings)
        self.port = int(self.twin.address.rpartition(":")[2])
        self._rows = {name: row for row, name in enumerate(subjects)}
        self._look = look
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera")
        self._zero = time.monotonic()

    def place(self, subject, position, yaw=0.0):
        with self._lock:
            self.twin.place(self._rows[subject], np.array(position, dtype=float), upright(yaw))

    def hide(self, subject):
        with self._lock:
            self.twin.hide(self._rows[subject])

    def occlude(self, seconds):
        """From now on, and for so long, nothing is seen."""
        with self._lock:
            self.twin.link.faults = Faults(occluded_from_s=time.monotonic() - self._zero, occluded_for_s=seconds)

    def kill(self):
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self.twin.close()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.kill()

    def _run(self):
        while not self._end.is_set():
            ready, _, _ = select.select(self.twin.sockets(), [], [], 0.002)
            t = time.monotonic() - self._zero
            with self._lock:
                for waiting in ready:
                    self.twin.serve(waiting, t)
                if self._look is not None:
                    self._look()
                self.twin.advance(t)
