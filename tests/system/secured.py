"""A laboratory as an intruder finds it: a router that knows who may do what, robots in flight, and certificates."""

import threading
import time
from contextlib import ExitStack

import msgspec
import pytest
import zenoh

from agents.network import lab, messages
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.definition import access_rights
from experiments.file.document import load
from experiments.real_time.hosts import authority
from tests.commands import ROOT
from tests.system.lab import TRIANGLE, RobotProcess, Started, Watcher

FILE = ROOT / "tests" / "system" / "secured.toml"


def forged(robot):
    """A pose that every check would believe."""
    return messages.encode(messages.pose(robot, 10**9, time.time(), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], yaw=0.0))


def refused():
    """Reaction of a router to a session that it does not let in."""
    return pytest.raises(zenoh.ZError, match="Unable to connect")


def new_lab(folder, *robots, **options):
    """A lab of all services and these robots, or those of the triangle."""
    members = {**{role: role for role in authority.SERVICES}, **dict.fromkeys(robots or TRIANGLE, "robot")}
    authority.create(folder, members, **options)
    return folder


class Laboratory:
    """Three robots in flight on a router that asks for certificates; `KH03`, who hears `KH01`, has not been started."""

    def __init__(self, folder, protocol="tls", *, linked=False):
        self.folder = folder / "lab"
        cases = load(FILE).cases()
        new_lab(self.folder, *next(iter(cases.values())).names)
        self.rights = folder / "rights.json"
        rights = msgspec.structs.replace(access_rights.rights(cases.values()), linked=linked)
        self.rights.write_bytes(msgspec.json.encode(rights))
        self.plain = free_endpoint(preferred_port=0, protocol=protocol)
        (self.endpoint,) = lab.secured([self.plain], self.folder)
        self.last = {}
        self._stack = ExitStack()
        self.serve(self.endpoint)

    def serve(self, endpoint, *more):
        """Starts a router."""
        words = ("--listen", endpoint, "--rights", str(self.rights), *more)
        router = self._stack.enter_context(Started("agents.runtime.router", *words))
        assert router.process.stdout.readline() == f"router ready on {endpoint}\n"

    def fly(self):
        """Starts the robots and brings them to where they run."""
        for name in TRIANGLE:
            self._stack.enter_context(RobotProcess(self.endpoint, FILE, name))
        self.watcher = self._stack.enter_context(Watcher(self.endpoint))
        self.watcher.take_off(*TRIANGLE)
        self.watcher.start(*TRIANGLE)

    def statuses(self):
        """Fresh ones, of every robot."""
        since, status = time.time(), self.watcher.status
        self.watcher.until(lambda: all(status[name].stamp > since for name in TRIANGLE), "fresh statuses")
        self.last = {name: status[name] for name in TRIANGLE}
        return self.last

    def session(self, identity, folder=None, plain=None):
        """A session of whoever has these certificates; at once, or zenoh.ZError."""
        (endpoint,) = lab.secured([plain or self.plain], folder or self.folder)
        return zenoh.open(config(settings("client", connect=[endpoint], name="intruder", identity=identity)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()


def steady(rate_hz, seconds):
    """Counts up, so many times a second."""
    begin, done = time.monotonic(), 0
    pause = threading.Event()
    while (now := time.monotonic() - begin) < seconds:
        while done < now * rate_hz:
            yield done
            done += 1
        pause.wait(0.001)
