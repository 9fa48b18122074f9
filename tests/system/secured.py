"""A laboratory as an intruder finds it: a router that knows who may do what, robots in flight, and certificates."""

import shutil
import threading
import time
from contextlib import ExitStack

import msgspec
import pytest
import zenoh

from agents.network import lab
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.definition import access_rights
from experiments.file.document import load
from experiments.real_time.hosts import authority
from tests.commands import ROOT
from tests.system.lab import RobotProcess, Started, Watcher

FILE = ROOT / "tests" / "system" / "secured.toml"
FLOWN = ("KH01", "KH02", "CF01")


def refused():
    """Reaction of a router to a session that it does not let in."""
    return pytest.raises(zenoh.ZError, match="Unable to connect")


class Laboratory:
    """Three robots in flight on a router that asks for certificates; `KH03`, who hears `KH01`, has not been started."""

    def __init__(self, folder, protocol="tls", *, linked=False):
        self.folder = folder / "lab"
        cases = load(FILE).cases()
        robots = dict.fromkeys(next(iter(cases.values())).names, "robot")
        authority.create(self.folder, {**{role: role for role in authority.SERVICES}, **robots})
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
        for name in FLOWN:
            self._stack.enter_context(RobotProcess(self.endpoint, FILE, name))
        self.watcher = self._stack.enter_context(Watcher(self.endpoint))
        self.watcher.take_off(*FLOWN)
        self.watcher.start(*FLOWN)

    def statuses(self):
        """Fresh ones, of every robot."""
        since = time.time()
        watcher = self.watcher
        watcher.until(lambda: all(watcher.status[name].stamp > since for name in FLOWN), "fresh statuses", 5.0)
        self.last = {name: watcher.status[name] for name in FLOWN}
        return self.last

    def session(self, identity, folder=None):
        """A session of whoever has these certificates; at once, or zenoh.ZError."""
        (endpoint,) = lab.secured([self.plain], folder or self.folder)
        return zenoh.open(config(settings("client", connect=[endpoint], name="intruder", identity=identity)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()


def elsewhere(folder, days=90.0):
    """Another lab with the same names, whose authority nobody here knows."""
    authority.create(folder, {**{role: role for role in authority.SERVICES}, "KH01": "robot"}, days=days)
    return folder


def copy(folder, target):
    """What a thief has of a lab."""
    shutil.copytree(folder, target)
    return target


def steady(rate_hz, seconds):
    """Counts up, so many times a second."""
    begin, done = time.monotonic(), 0
    pause = threading.Event()
    while (now := time.monotonic() - begin) < seconds:
        while done < now * rate_hz:
            yield done
            done += 1
        pause.wait(0.001)
