"""Whatever arrives on the network: the messages themselves, and every process that polls it."""

import io
import tempfile
import time
from contextlib import ExitStack, closing, redirect_stdout, suppress
from itertools import count
from math import isnan
from pathlib import Path
from threading import Event

import msgspec
import numpy as np

from agents.body.fleet import assemble
from agents.network import messages as wire
from agents.network.name_ownership import OwnershipCheck
from agents.runtime.loop import Runtime, Setup
from agents.vectors import is_finite
from bridges.external import ExternalBody
from experiments.definition import bodies
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.case_processes import CaseContext
from experiments.real_time.conductor.conductor import Conductor
from experiments.real_time.hosts.hosts import Hosts
from experiments.real_time.processes.joining import Network
from experiments.real_time.processes.recorder import Recorder
from experiments.real_time.processes.world import WorldProcess
from experiments.real_time.processes.world_population import WorldBodies
from experiments.recording.writer import Recording
from tests.fuzz.messages import KEYS, everything, good, of_all, sent
from tests.fuzz.target import Place, Renewed, Target
from tests.network import Net, Reply, Sample
from tests.requests import request
from tools.commands.network import members, readable
from twins.devices.vicon import TruthSubscription, ViconTwin


class HandDrivenRobot(Runtime):
    def begin(self, utc):
        self._utc = self._telemetry.utc = utc


class HandDrivenWorld(WorldProcess):
    def step(self, t):
        self._tick(t)
        if self._pace.update(t, 0.01):
            self._report(t)


class HandDrivenConductor(Conductor):
    def begin(self):
        self._join(ExitStack())
        self._changes.begin(time.time())

    def step(self):
        self._update()


RUBBISH = io.StringIO()  # where processes say what they would say on a terminal


def messages():
    """Every struct, both encodings: what is decoded can be encoded again."""
    kinds = {kind.__name__: kind for kind in wire.Message.__subclasses__()}
    examples = []
    for said in [*good("KH01").values(), *of_all().values()]:
        for message in said:
            examples += sent(type(message).__name__, message)
    for kind in (wire.Reply("KH01", True, "ready", "", 0.1), wire.WorldReply(True, False, 0.1, "")):
        examples += sent(type(kind).__name__, kind)
    names = list(kinds.values())

    def take(data):
        name, _, rest = data.partition(b"\0")
        mime, _, payload = rest.partition(b"\0")
        kind = kinds.get(name.decode("utf-8", "replace")) or names[len(data) % len(names)]
        message = wire.decode(payload, mime.decode("utf-8", "replace"), kind)
        wire.encode(message)
        with suppress(OverflowError):  # JSON holds whole numbers of any length
            wire.encode(message, "msgpack")

    yield Target(examples, take, (wire.Malformed,))


def robot():
    """A robot's process: poses, tokens, orders, stops, positions, ranges; its body is never told nonsense."""
    experiment = document.read("triangle", ["robots.KH01.position=external", "avoidance=barrier"]).experiment

    def make():
        net.forget()
        body = assemble(bodies.body_request(Plan(experiment), ["KH01"], 1, ["tcp/127.0.0.1:1"]))
        setup = Setup(KEYS, [], "json", 50.0, lifeline=False, externally_measured=[True], ranging=["world"])
        runtime = HandDrivenRobot([Plan(experiment).assignment("KH01")], body, setup)
        body.open()
        runtime.subscribe_to_stops(net.session)
        runtime.join(net.session)
        began, command = time.time(), body.command
        runtime.begin(began)

        def told(setpoints):
            for setpoint in setpoints:
                assert all(isnan(number) or abs(number) < 10.0 for number in setpoint), setpoint
            command(setpoints)

        body.command = told
        for k in range(1, 6):
            for name in ("KH01", "KH02", "CF01"):
                for what in ("pose", "position"):
                    message = msgspec.structs.replace(good(name)[what][0], stamp=began + 0.01 * k)
                    if what == "pose":
                        message = msgspec.structs.replace(message, seq=k)
                    net.deliver(sent(f"park/{name}/{what}", message)[0])
                net.deliver(f"park/{name}/alive\0\0".encode())
            if k > 2:
                order = wire.Order("takeoff") if k == 3 else wire.Order("start", at=began + 0.01 * k)
                net.deliver(sent("park/KH01/order", order)[0])
            runtime.tick(0.01 * k)
        for k in count(6):
            data = yield
            net.deliver(data, gone=len(data) % 16 == 0)
            runtime.tick(0.01 * k)

    with Net().worn() as net, redirect_stdout(RUBBISH):
        yield Target(everything("KH01", "KH02", "CF01"), Renewed(make, 200))


def world():
    """The twin service: commands, states of those elsewhere, statuses, and orders to put things in and out."""
    changes = ["robots.KH01.body=world", "robots.KH02.body=world", "world.engine=pymunk"]
    experiment = document.read("triangle", changes).experiment

    def make():
        net.forget()
        joint = Network(net.session, KEYS, [], [], OwnershipCheck([]))
        population = WorldBodies(Plan(experiment))
        process = HandDrivenWorld(Plan(experiment), population, joint, Event())
        process.utc = time.time()
        for k in count(1):
            net.deliver((yield))
            process.step(0.01 * k)
            for carried, state in zip(population.carried, population.states, strict=True):
                assert not carried or is_finite(state.position)

    with Net().worn() as net, redirect_stdout(RUBBISH):
        yield Target(everything("KH01", "KH02", "CF01"), Renewed(make, 200))


def recorder():
    """The recorder writes what is honest and counts the rest; what it wrote can be read."""
    experiment = document.read("triangle").experiment

    def make():
        net.forget()
        path = Path(folder) / f"{time.monotonic_ns()}.mcap"
        with Recording(path, Plan(experiment), case="only", seed=1, clock="real") as recording:
            made = Recorder(net.session, KEYS, recording)
            while True:
                net.deliver((yield))
                made.receive()

    with tempfile.TemporaryDirectory() as folder, Net().worn() as net, closing(Renewed(make, 1000)) as take:
        yield Target(everything("KH01", "KH02"), take)


def conductor():
    """The conductor follows the robots' statuses, states and tokens, and changes robots when it is asked."""
    experiment = document.read("triangle").experiment

    class Nobody:
        last_silence = -np.inf

        def died(self):
            return []

        def running(self, _name):
            return False

        def start(self, *_, forked=False): ...

        release = kill = start

    def make():
        net.forget()
        context = CaseContext(
            Plan(experiment), "only", Path(folder), source=Path(folder) / "only.json", endpoints=["tcp/127.0.0.1:1"],
            launcher=Nobody(), hosts=Hosts(Nobody(), []),
        )  # fmt: skip
        made = HandDrivenConductor(context, lambda _: None)
        made.begin()
        while True:
            data = yield
            net.deliver(data, gone=len(data) % 16 == 0)
            made.step()

    with tempfile.TemporaryDirectory() as folder, Net().worn() as net, redirect_stdout(RUBBISH):
        yield Target(everything("KH01", "KH02", "CF01"), Renewed(make, 500))


def external_body():
    """A body elsewhere says where it is and what it sees."""

    def make():
        net.forget()
        for name in ("KH01", "KH02"):
            key = KEYS.position(name)
            place = wire.Position(name, time.time(), (0.0, 0.0, 0.0), 0.1)
            net.first[key] = Sample(key, wire.JSON, wire.encode(place))
        body = ExternalBody(
            request("khepera4", ["external"] * 2, names=["KH01", "KH02"], endpoints=["tcp/127.0.0.1:1"])
        )
        body.open()
        for k in count(1):
            net.deliver((yield))
            assert all(is_finite(state.position) for state in body.read(0.01 * k))
            body.command([(0.0, 0.0, 0.0, 0.0)] * 2)

    with Net().worn() as net:
        yield Target(everything("KH01", "KH02", only=("position", "ranges", "state")), Renewed(make, 200))


def vicon_truths():
    """The simulated Vicon hears where twins are."""

    def make():
        net.forget()
        with closing(ViconTwin(["KH01", "KH02"])) as vicon:
            truths = TruthSubscription(net.session, KEYS, ["KH01", "KH02"])
            for k in count(1):
                net.deliver((yield))
                truths.update(vicon, time.time())
                vicon.advance(0.01 * k)

    with Net().worn() as net, closing(Renewed(make, 10_000)) as take:
        yield Target(everything("KH01", "KH02", only=("truth",)), take)


def answers():
    """Answers to orders, and the admin space that network tools read."""
    examples = []
    for message in (wire.Reply("KH01", True, "ready", "", 0.1), wire.WorldReply(True, False, 1.0, "")):
        examples += sent("park/KH01/order", message)
    admin = {
        "@/f00d/router/token/park/KH01/alive": b'{"clients":["aa","bb"],"peers":[]}',
        "@/f00d/router/publisher/park/KH01/pose": b'{"clients":["aa"]}',
        "@/aa/client": b'{"zid":"aa","metadata":{"name":"KH01"}}',
        "@/f00d/router": b'{"zid":"f00d","metadata":null}',
    }
    examples += [b"\0".join([key.encode(), b"application/json", text]) for key, text in admin.items()]

    def take(data):
        key, _, rest = data.partition(b"\0")
        mime, _, payload = rest.partition(b"\0")
        kind = mime.decode("utf-8", "replace")
        net.replies = [Reply(Sample(key.decode("utf-8", "replace"), kind, payload), good=len(data) % 8 > 0)]
        assert isinstance(orders.send_order(net.session, KEYS, ["KH01"], wire.Order("hold"))["KH01"], wire.Reply)
        assert isinstance(orders.send_world_order(net.session, KEYS, wire.WorldOrder("pause")), wire.WorldReply)
        assert readable(payload, kind).isprintable()
        for member in members(net.session):
            msgspec.json.encode(member)

    net = Net()
    yield Target(examples, take)


PLACES = {
    "messages": Place(messages, 300_000, 1000),
    "robot": Place(robot, 100_000, 600),
    "world": Place(world, 50_000, 300),
    "recorder": Place(recorder, 60_000),
    "conductor": Place(conductor, 60_000),
    "external-body": Place(external_body, 30_000),
    "vicon-truths": Place(vicon_truths, 20_000),
    "answers": Place(answers, 40_000),
}
