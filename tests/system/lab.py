"""A run as a test sees it: real processes, a real router, and a session of the test's own to look and to order."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from experiments.file import catalogue
from experiments.real_time.conductor import orders
from experiments.recording import playback
from tests import commands
from tests.commands import GUARD, ROOT, environment
from tests.waiting import PATIENCE_S, until
from tools.commands.run import SPOILED

ENVIRONMENT = environment()
# Robots of the reference experiment begin within some 0.3 m of where the formation ends up, which takes half the time.
PLACES = {"KH01": [-0.6, 0.0], "KH02": [0.2, 0.0], "KH03": [0.2, 0.8], "CF01": [-0.5, 0.2], "CF02": [0.2, 0.2]}
NEAR = [f"robots.{name}.start={place}" for name, place in PLACES.items()]
TRIANGLE = ("KH01", "KH02", "CF01")
# The same of the triangle, whose drone is also soon up and down.
NEAR_TRIANGLE = [
    "robots.KH01.start=[-0.35, -0.3]", "robots.KH02.start=[0.35, -0.3]",
    "robots.CF01.start=[0.05, 0.44]", "robots.CF01.hover=0.3",
    "formation.gain=1.4",  # its links are more level than those of the file, and pull more
]  # fmt: skip


def options(*words):
    """Words of a command; those like `duration_s=4` are settings."""
    made = []
    for word in map(str, words):
        is_setting = "=" in word and word[0] != "-" and made[-1:] not in (["--set"], ["--connect"])
        made += ["--set", word] if is_setting else [word]
    return made


def in_lab(folder):
    """The triangle as a file beside its lab."""
    file = folder / "triangle.toml"
    file.write_text(catalogue.path("triangle").read_text("utf-8") + '\n[network]\nlab = "lab"\n', "utf-8")
    commands.zenpark("lab", "init", folder / "lab", file)
    return file


def typed(file, topic):
    """Messages of a topic, as another library decodes them from the schema in the file.

    Payloads of the network have their fields as attributes, with `logged` [s, UTC].
    """
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [(one.message.log_time, one.decoded_message) for one in reader.iter_decoded_messages([topic])]
    return [_with_fields(each, at / 1e9) if hasattr(each, "data") else each for at, each in found]


def _with_fields(message, logged):
    fields = json.loads(message.data, object_hook=lambda part: SimpleNamespace(**part))
    fields.logged = logged
    return fields


class Watcher:
    """Everything that robots say, from a session of the test's own; poll with `look`."""

    def __init__(self, *endpoints):
        self.keys, self.alive, self._inboxes = Keys(), set(), []
        self.session = network.open_session(endpoints, name="test", identity="operator")
        self._feed = pubsub.RobotFeed(self.session, self.keys)
        self.status, self.state = self._newest(self._feed.statuses), self._newest(self._feed.states)

    def every(self, key, kind, subscribe=pubsub.subscriber):
        """List to which each message of a key is appended."""
        found = []
        self._inboxes.append((pubsub.Inbox(subscribe(self.session, key, 8192), kind), found.append))
        return found

    def newest(self, key, kind, subscribe=pubsub.subscriber):
        """Last message of each robot, by its name."""
        return self._newest(pubsub.Inbox(subscribe(self.session, key, 8192), kind))

    def _newest(self, inbox):
        found = {}
        self._inboxes.append((inbox, lambda message: found.update({message.robot: message})))
        return found

    def look(self):
        for inbox, keep in self._inboxes:
            for message in inbox.read():
                keep(message)
        for robot, there in self._feed.alive():
            (self.alive.add if there else self.alive.discard)(robot)

    def until(self, true, what, limit_s=PATIENCE_S):
        """Looks until something is true; while it asks for a robot that has said nothing yet, it is not."""

        def seen():
            self.look()
            with contextlib.suppress(KeyError):
                return true()
            return False

        until(seen, what, limit_s)

    def phase(self, robot):
        return self.status[robot].phase if robot in self.status else ""

    def all(self, phase, *names):
        return all(self.phase(name) == phase for name in names)

    def until_all(self, phase, *names):
        self.until(lambda: self.all(phase, *names), f"{', '.join(names)}: {phase}")

    def order(self, robot, order):
        return orders.send_order(self.session, self.keys, [robot], order, PATIENCE_S)[robot]

    def give(self, order, *names):
        """Order that all of them carry out."""
        for name in names:
            reply = self.order(name, order)
            assert reply.ok, reply

    def take_off(self, *names):
        self.until_all("ready", *names)
        self.give(messages.Order("takeoff"), *names)
        self.until_all("airborne", *names)

    def start(self, *names):
        self.give(messages.Order("start", at=time.time() + 0.3), *names)
        self.until_all("running", *names)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.session.close()


class Started:
    """A process started by hand as a user would, with its standard input held open."""

    patience_s = 100.0  # for its end

    def __init__(self, module, *arguments):
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        command = [sys.executable, "-m", module, *map(str, arguments)]
        self.process = subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, text=True, **streams)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        """Ends it, unless it has ended, even if it is frozen."""
        if self.process.poll() is None:
            self.thaw()
        self.end()

    def freeze(self):
        self.process.send_signal(signal.SIGSTOP)

    def thaw(self):
        self.process.send_signal(signal.SIGCONT)

    def said(self):
        """The rest of its output, after its end."""
        return self.process.stdout.read()

    def end(self):
        """SIGTERM: robots land and a world's are waited for, then it ends."""
        self.process.terminate()
        return self.wait()

    def kill(self):
        self.process.kill()
        self.wait()

    def wait(self, limit_s=None):
        code = self.process.wait(self.patience_s if limit_s is None else limit_s)
        for stream in (self.process.stdin, self.process.stdout):
            stream.close()
        return code


class RobotProcess(Started):
    """`./zenpark agent`."""

    def __init__(self, endpoint, file, *names, lifeline=False):
        more = ["--lifeline"] if lifeline else []
        super().__init__(ROBOT, str(file), *names, "--connect", endpoint, *more)


class WorldProcess(Started):
    """`./zenpark world serve`, whose first line is `ready`."""

    def __init__(self, endpoint, file, *arguments):
        super().__init__("experiments.real_time.processes.world", str(file), "--connect", endpoint, *arguments)
        self.ready = self.process.stdout.readline().strip()


ROBOT = "experiments.real_time.processes.robot"
ROLES = {
    "experiments.real_time.processes.zygote": "zygote",
    "agents.runtime.router": "router",
    "experiments.real_time.processes.recorder": "recorder",
    "experiments.real_time.processes.world": "world",
    "experiments.real_time.processes.centre": "centre",
}  # of processes, by their modules


CAPTURE = {
    "bridges.motion_capture.publisher": "{}",
    "bridges.motion_capture.twin.capture": "{}-twin",
}  # roles, with the system


class Flight:
    """`./zenpark run` in a process of its own; words like `duration_s=4` are settings."""

    def __init__(self, folder, file, *words, report=False):
        self.folder = folder
        words = words if report else (*words, "--no-report")
        self._errors = (folder.parent / f"{folder.name}.stderr").open("w+")
        command = [sys.executable, *GUARD, "run", str(file), "--out", str(folder), *options(*words)]
        streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": self._errors}
        variables = {**ENVIRONMENT, "PATH": os.environ["PATH"]}  # a test may put an ssh of its own there
        self.process = subprocess.Popen(command, cwd=ROOT, env=variables, text=True, start_new_session=True, **streams)

    def children(self):
        """The processes that it started, by robot name or role, such as "zygote", "router", "vicon", "vicon-twin"."""
        found = {}
        for child in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
                line = child.cmdline()
                names = [role for module, role in ROLES.items() if module in line]
                for module, role in CAPTURE.items():
                    names += [role.format(line[line.index(module) + 1])] if module in line else []
                if ROBOT in line:
                    names = line[line.index(ROBOT) + 2 : line.index("--connect")]
                found |= dict.fromkeys(names, child)
        return found

    def endpoint(self):
        """The router's."""
        line = self.children()["router"].cmdline()
        return line[line.index("--listen") + 1]

    def said(self):
        return Path(self._errors.name).read_text()

    def until_flown(self):
        self.until_said("phase conductor: formation")

    def until_said(self, pattern, limit_s=2.0 * PATIENCE_S):
        def said_or_over():
            return bool(re.search(pattern, self.said())) or self.process.poll() is not None

        with contextlib.suppress(AssertionError):
            until(said_or_over, pattern, limit_s)
        assert re.search(pattern, self.said()), f"{pattern!r} not said, but:\n{self.said()}\n{self.logs()}"

    def read(self, case="event"):
        """The recording of a case."""
        return playback.read(self.folder / f"{case}.mcap")

    def logs(self):
        """Output of the processes."""
        files = sorted((self.folder / "logs").glob("*.log"))
        return "\n".join(f"{file.name}: {file.read_text()[-500:]}" for file in files)

    def interrupt(self):
        """Ctrl-C: all land; standard output."""
        self.process.send_signal(signal.SIGINT)
        code, out = self.finish()
        assert code == 130, self.logs()
        return out

    def finish(self, limit_s=60.0):
        """Exit code and standard output; a machine that was busy spoils figures, and nothing that is tested here."""
        out, _ = self.process.communicate(timeout=limit_s)
        self._errors.close()
        return 0 if self.process.returncode == SPOILED else self.process.returncode, out


def gone(processes):
    """Whether none of them runs any more; a zombie that nobody reaps counts as gone."""
    return not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in processes)


def assert_formed(trace, within_m, since_s):
    """Mean error of each link of a distance since a time of the run [s]."""
    late = trace.time > since_s
    rows = {name: row for row, name in enumerate(trace.robots)}
    for text, link in trace.plan.experiment.formation.links.items():
        one, _, other = text.split()
        apart = np.linalg.norm(trace.true_position[late, rows[one]] - trace.true_position[late, rows[other]], axis=1)
        assert np.abs(apart - (link if isinstance(link, float) else link.distance)).mean() < within_m, text


SLOW_S = 10.0  # for a busy machine; the lease of the router is six times as long


def assert_held_in_time(flight, case, stopped):
    """Robots of a finished run held because the router froze at `stopped` [s, UTC], as each recorded it itself.

    On a busy machine a router may be silent once more.
    """
    trace = flight.read(case).trace
    said = [event.text for event in trace.events if event.source == "conductor"]
    assert any("no router answers" in text for text in said)
    for name in trace.plan.experiment.robots:
        status = typed(flight.folder / f"{case}.mcap", f"/{name}/status")[-1]
        incidents = [each for each in status.incidents if "no connection to a router" in each.text]
        hold, over, *_ = [each for each in incidents if each.stamp > stopped]
        assert hold.text.startswith("hold: ")
        assert hold.stamp < stopped + trace.plan.experiment.safety.neighbour_timeout_s + SLOW_S
        assert over.text.startswith("over: ")
