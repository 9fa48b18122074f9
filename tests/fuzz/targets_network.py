"""Whatever arrives on the network: the messages themselves, and every process that polls it."""

import tempfile
import time
from contextlib import ExitStack, closing, suppress
from functools import cache, partial
from itertools import count
from math import isnan
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import msgspec
import numpy as np

from agents.body.fleet import assemble
from agents.network import messages as wire
from agents.network.name_ownership import OwnershipCheck
from agents.runtime.loop import Runtime, Setup
from agents.vectors import is_finite
from bridges.external import ExternalBody
from bridges.motion_capture.twin.capture import TruthSubscription
from bridges.motion_capture.twin.vicon import ViconTwin
from experiments.definition import bodies
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
from tests.fuzz.target import Target, place, renewed, split
from tests.network import Net, Reply, Sample
from tests.requests import request
from tools.commands.network import members, readable


@cache
def triangle(*changes):
    return document.read("triangle", changes).plan


REPLIES = (wire.Reply("KH01", True, "ready", "", 0.1), wire.WorldReply(True, False, 0.1, ""))


@place(300_000, 1000)
def messages():
    """Every struct, both encodings: what is decoded can be encoded again."""
    kinds = {kind.__name__: kind for kind in wire.Message.__subclasses__()}
    several = [*good("KH01").values(), *of_all().values(), REPLIES]
    examples = [part for said in several for each in said for part in sent(type(each).__name__, each)]
    names = list(kinds.values())

    def take(data):
        name, rest = split(data)
        mime, payload = split(rest)
        message = wire.decode(payload, mime, kinds.get(name) or names[len(data) % len(names)])
        wire.encode(message)
        with suppress(OverflowError):  # JSON holds whole numbers of any length
            wire.encode(message, "msgpack")

    yield Target(examples, take, (wire.Malformed,))


THREE = partial(everything, "KH01", "KH02", "CF01")


@renewed(200, THREE, 100_000, 600)
def robot(net):
    """A robot's process: poses, tokens, orders, stops, positions, ranges; its body is never told nonsense."""
    plan = triangle("robots.KH01.position=external", "avoidance=barrier")
    body = assemble(bodies.body_request(plan, ["KH01"], 1, ["tcp/127.0.0.1:1"]))
    setup = Setup(KEYS, [], "json", 50.0, lifeline=False, externally_measured=[True], ranging=["world"])
    runtime = Runtime([plan.assignment("KH01")], body, setup)
    body.open()
    runtime.subscribe_to_stops(net.session)
    runtime.join(net.session)
    began, command = time.time(), body.command
    runtime._utc = runtime._telemetry.utc = began

    def told(setpoints):
        assert all(isnan(number) or abs(number) < 10.0 for setpoint in setpoints for number in setpoint), setpoints
        command(setpoints)

    body.command = told
    for k in range(1, 6):
        for name in ("KH01", "KH02", "CF01"):
            for what, counted in (("pose", {"seq": k}), ("position", {})):
                message = msgspec.structs.replace(good(name)[what][0], stamp=began + 0.01 * k, **counted)
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


@renewed(200, THREE, 50_000, 300)
def world(net):
    """The twin service: commands, states of those elsewhere, statuses, and orders to put things in and out."""
    plan = triangle("robots.KH01.body=world", "robots.KH02.body=world", "world.engine=pymunk")
    population = WorldBodies(plan)
    process = WorldProcess(plan, population, Network(net.session, KEYS, [], [], OwnershipCheck([])), Event())
    process.utc = time.time()
    for k in count(1):
        net.deliver((yield))
        process._tick(0.01 * k)
        if process._pace.update(0.01 * k, 0.01):
            process._report(0.01 * k)
        for carried, state in zip(population.carried, population.states, strict=True):
            assert not carried or is_finite(state.position)


@renewed(1000, partial(everything, "KH01", "KH02"), 60_000)
def recorder(net):
    """The recorder writes what is honest and counts the rest; what it wrote can be read."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Recording(Path(folder) / "x.mcap", triangle(), case="only", seed=1, clock="real") as recording,
    ):
        made = Recorder(net.session, KEYS, recording)
        while True:
            net.deliver((yield))
            made.receive()


@renewed(500, THREE, 60_000)
def conductor(net):
    """The conductor follows the robots' statuses, states and tokens, and changes robots when it is asked."""
    changes = dict.fromkeys(("start", "stop", "release", "kill", "tell"), lambda *_, **__: SimpleNamespace())
    launcher = SimpleNamespace(last_silence=-np.inf, died=list, running=lambda _name: False, land_s=15.0, **changes)
    with tempfile.TemporaryDirectory() as name:
        folder, hosts = Path(name), Hosts(launcher, [])
        context = CaseContext(triangle(), "only", folder, folder / "x", ["tcp/127.0.0.1:1"], launcher, hosts)
        made = Conductor(context, lambda _: None)
        made._join(ExitStack())
        made._changes.begin(time.time())
        while True:
            data = yield
            net.deliver(data, gone=len(data) % 16 == 0)
            made._update()


@renewed(200, partial(everything, "KH01", "KH02", only=("position", "ranges", "state")), 30_000)
def external_body(net):
    """A body elsewhere says where it is and what it sees."""
    names = ["KH01", "KH02"]
    for name in names:
        place = wire.Position(name, time.time(), (0.0, 0.0, 0.0), 0.1)
        net.first[KEYS.position(name)] = Sample(KEYS.position(name), wire.JSON, wire.encode(place))
    body = ExternalBody(request("khepera4", ["external"] * 2, names=names, endpoints=["tcp/127.0.0.1:1"]))
    body.open()
    for k in count(1):
        net.deliver((yield))
        assert all(is_finite(state.position) for state in body.read(0.01 * k))
        body.command([(0.0, 0.0, 0.0, 0.0)] * 2)


@renewed(10_000, partial(everything, "KH01", "KH02", only=("truth",)), 20_000)
def vicon_truths(net):
    """The simulated Vicon hears where twins are."""
    with closing(ViconTwin(["KH01", "KH02"])) as vicon:
        truths = TruthSubscription(net.session, KEYS, ["KH01", "KH02"])
        for k in count(1):
            net.deliver((yield))
            truths.update(vicon, time.time())
            vicon.advance(0.01 * k)


@place(40_000)
def answers():
    """Answers to orders, and to the questions of network tools."""
    examples = [part for message in REPLIES for part in sent("park/KH01/order", message)]
    examples += [part for message in good("KH01", 1)["status"] for part in sent(KEYS.status("KH01"), message)]
    tokens = (KEYS.alive("KH01"), KEYS.life(KEYS.alive("KH01"), "f00d"), "park/KH01/pose/@adv/pub/f00d/1/_")
    examples += [b"\0".join([key.encode(), b"application/json", b""]) for key in tokens]

    def take(data):
        key, rest = split(data)
        kind, payload = split(rest)
        net.replies = [Reply(Sample(key, kind, payload), good=len(data) % 8 > 0)]
        assert isinstance(orders.send_order(net.session, KEYS, ["KH01"], wire.Order("hold"))["KH01"], wire.Reply)
        assert isinstance(orders.send_world_order(net.session, KEYS, wire.WorldOrder("pause")), wire.WorldReply)
        assert readable(payload, kind).isprintable()
        for member in members(net.session, listen_s=0.0):
            msgspec.json.encode(member)

    net = Net()
    yield Target(examples, take)
