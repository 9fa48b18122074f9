"""A protocol twin served by a thread, for the tests of devices and bridges."""

import select
import threading
import time
from dataclasses import replace

from twins.devices.device import DeviceRequest, Faults


class Served:
    """A device in a thread: waits on its sockets and ticks it, as its own process would."""

    def __init__(self, factory, body, **faults):
        self.device = factory(DeviceRequest(body, Faults(**faults)))
        self.addresses = self.device.addresses
        self.zero = time.monotonic()
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._period = 1.0 / body.rate_hz
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        due = time.monotonic()
        while not self._ending.is_set():
            ready, _, _ = select.select(self.device.sockets(), [], [], max(0.0, due - time.monotonic()))
            with self._lock:
                now = time.monotonic()
                for wire in ready:
                    if wire in self.device.sockets():
                        self.device.serve(wire, now - self.zero)
                if now >= due:
                    self.device.advance(now - self.zero)
                    due = max(due + self._period, now - 0.1)

    def truth(self):
        with self._lock:
            return self.device.truth()

    def kill(self):
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join()
            self.device.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()


def reached(body, addresses):
    """The same request for the bridge, at the addresses that the device gave out."""
    return replace(body, addresses=tuple(addresses))
