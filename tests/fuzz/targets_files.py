"""Files and what stands on command lines: experiments, their changes, imports, recordings, sweeps, addresses."""

import argparse
import hashlib
import io
import json
import shutil
import struct
import tempfile
import time
import zipfile
import zlib
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from math import isfinite
from pathlib import Path

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from agents.body.capture_reader import parse_server
from agents.body.interface import BodyError, settings
from agents.errors import ExplainedError
from agents.network import messages as wire
from agents.network import zenoh_config as sessions
from agents.plugins import registry
from agents.plugins.recorded import formats
from bridges.crazyflie.geometry import stations
from bridges.crazyflie.protocol import addresses as crazyflie
from bridges.khepera4 import protocol as khepera4
from bridges.khepera4.link import KheperaAddress
from bridges.tello import protocol as tello
from bridges.turtlebot3 import protocol as turtlebot3
from experiments.authoring import crazyswarm
from experiments.authoring.robotic_park.convert import convert_text
from experiments.catalogue import index
from experiments.definition.links import link_pairs
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import DocumentError, write_json
from experiments.file.text import decoded
from experiments.recording import bundle, playback
from experiments.recording import writer as recording
from experiments.recording.reader import RecordingError, recover
from experiments.recording.run_folder import METRICS, ORIGIN, SOURCE, differences, past_runs
from experiments.sweep import store
from experiments.sweep.plan import arguments, cells, seeds_of
from experiments.sweep.runs import RunMetrics
from experiments.sweep.store import RUNS, Store, StoreOrigin
from tests.agents.plugins import test_recorded as trajectory_files
from tests.experiments import robotic_park_files as theirs
from tests.experiments.authoring import test_crazyswarm as swarms
from tests.experiments.file import test_graphs as graph_files
from tests.fuzz.messages import KEYS, good, of_all
from tests.fuzz.target import Target, place, split
from tools.commands.network import key_expression
from twins.device import Faults

MALFORMED = Path(__file__).parents[1] / "experiments" / "file" / "malformed"


@contextmanager
def place_for(name):
    """A file of that name in a folder of its own, in memory where there is such a place."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder) / name


def refusing_well(take):
    """A refusal has a text that can be printed."""

    def checked(data):
        try:
            take(data)
        except DocumentError as error:
            if not (error.problems and all(problem.message for problem in error.problems)):
                raise AssertionError("refused without a word") from error
            str(error).encode("utf-8")
            raise

    return checked


def experiment(suffix, examples):
    """An experiment file; what is read can be written and read again."""
    with place_for(f"some{suffix}") as file:
        for arena in index.FOLDER.glob("*.arena.toml"):
            (file.parent / arena.name).write_bytes(arena.read_bytes())

        @refusing_well
        def take(data):
            file.write_bytes(data)
            assert all(write_json(case) for case in document.read(file).cases().values())

        yield Target(examples, take, (DocumentError,))


@place(12_000, 120)
def toml():
    """The catalogue, and every malformed file of the tests."""
    files = [*sorted(index.FOLDER.glob("*.toml")), *sorted(MALFORMED.glob("*.toml"))]
    small = b'title = "x"\nduration_s = 1.0\n[robots]\nK = { kind = "khepera4", start = [0, 0] }\n[cases.a]\n'
    # as often as a fifth of the malformed ones: some of the few inputs of a quick run are read
    return experiment(".toml", [small] * max(1, len(files) // 5) + [file.read_bytes() for file in files])


@place(8_000, 40)
def resolved():
    """Cases as the processes are told them."""
    names = ("triangle", "convoy", "obstacle-course")
    return experiment(".json", [write_json(document.read(name).plan) for name in names])


@place(8_000, 40)
def arena():
    """An arena file beside an experiment."""
    text = '[robots.K]\nkind = "khepera4"\nstart = [0, 0]\n[arena]\nfile = "a.arena.toml"\n'
    with place_for("some.toml") as file:
        file.write_text(f'title = "x"\nduration_s = 1.0\n{text}')

        @refusing_well
        def take(data):
            (file.parent / "a.arena.toml").write_bytes(data)
            document.read(file)

        examples = [each.read_bytes() for each in sorted(index.FOLDER.glob("*.arena.toml"))]
        yield Target([*examples, b"[arena]\nsize = [4, 4, 2]\n"], take, (DocumentError,))


@place(12_000, 60)
def overrides():
    """Arguments of `--set`, one a line."""
    flags = [
        "robots.KH01.start=[0.1, 0.2]", "formation.gain=2.5", "trigger.threshold=0.02", "trigger.kind=mixed",
        "cases.event.trigger=periodic", "timeline.0.at_s=3", 'formation.links."KH01 - KH02"=0.5', "seed=7",
        "arena.obstacles.box={ at = [0, 0.5], radius = 0.1 }", "formation.changes=[{ at_s = 1, scale = 2 }]",
        "disturbance.all.hover_jitter={}", "rates.body_hz=100", "avoidance=barrier", "network.connect=[]",
    ]  # fmt: skip
    examples = [flag.encode() for flag in flags] + ["\n".join(flags[k : k + 3]).encode() for k in range(10)]

    @refusing_well
    def take(data):
        name = "robotic-park" if len(data) % 4 == 0 else "triangle"
        assert document.read(name, data.decode("utf-8", "surrogateescape").split("\n")[:8]).cases()

    yield Target(examples, take, (DocumentError,))


@place(4_000, 25)
def park_yaml():
    """Files of Robotic Park's authors; what becomes of them is read."""
    texts = [theirs.dome(4), theirs.column(3, 1), theirs.dome(5, origin=True, real=(0,))]
    examples = [text.encode() for text in (*texts, "".join(map(theirs.flat, theirs.OTHERS)))]
    with place_for("some.toml") as file:

        @refusing_well
        def take(data):
            text, _ = convert_text(decoded(data, "some.yaml"), "some.yaml", 20.0)
            file.write_text(text, encoding="utf-8")
            with suppress(DocumentError):  # robots that stand in each other are for its user to see
                document.read(file)

        yield Target(examples, take, (DocumentError,))


@place(4_000, 40)
def crazyflies_yaml():
    """Drones of Crazyswarm2 and Crazyswarm; what becomes of them is read."""
    examples = [swarms.swarm(swarms.drone(1), swarms.drone(2, "false"), captured="true"), swarms.OLD]

    @refusing_well
    def take(data):
        made, _ = crazyswarm.convert_text(decoded(data, "some.yaml"), "some.yaml", 20.0)
        document.loads(made)

    yield Target([text.encode() for text in examples], take, (DocumentError,))


@place(8_000, 100)
def trajectories():
    """Plans from files: each can be asked for any time."""
    examples = ["t,x,y,z,yaw\n5,0,0,0.5,0\n6,1,2,0.7,1\n", "0 0 0 1 0 0 0 1\n1 1 0 1 0 0 1 0\n", trajectory_files.VICON]
    examples += [trajectory_files.MOTIVE.replace("cf 1", "drone"), trajectory_files.QTM]
    examples.append(trajectory_files.TOPICS.replace("CF01", "drone"))
    examples.append(trajectory_files.RUN.replace("R1", "drone").replace("b,1", "a,1"))
    examples.append("# timestamp tx ty tz qw qx qy qz\n0 0 0 1 0 0 0 1\n1 1 0 1 1 0 0 0\n")
    examples.append(f"{trajectory_files.HEADER}\n{trajectory_files.piece(2, x=(0, 1), yaw=(0.5,))}\n")

    def take(data):
        curve = formats.read(data.decode("utf-8", "replace"), "drone")
        assert curve.duration > 0.0
        for share in (-1.0, 0.0, 0.3, 1.0, 2.0):
            assert isfinite(sum(curve.pose(share * curve.duration)[:2]) + curve.speed)

    yield Target([text.encode() for text in examples], take, (formats.FormatError,))


@place(8_000, 60)
def graphs():
    """A graph beside an experiment."""
    drawn = graph_files.LABELLED.format(graph_files.YED.format("A"), graph_files.YED.format("B"))
    examples = [
        b"A B 0.5\nB C\n",
        graph_files.MATRIX.encode(),
        graph_files.graphml('<edge source="A" target="B"/>').encode(),
        b"A B {'weight': np.float64(0.5), 'distance': 1}\n",
        b",source,target,distance,Type\n0,A,B,0.5,Directed\n",
        graph_files.graphml(f'{drawn}<edge source="n0" target="n1"/>').encode(),
    ]
    with place_for("some.toml") as file:
        rows = 'graph = { file = "a.graph", target = 0.7, rows = "senders" }\n'
        file.write_text(f"{graph_files.ROBOTS}[formation]\n{rows}")

        @refusing_well
        def take(data):
            (file.parent / "a.graph").write_bytes(data)
            document.read(file)

        yield Target(examples, take, (DocumentError,))


def recording_of_a_second():
    """A recording with every topic."""
    what = document.read("triangle", ["duration_s=1.0", "timeline=[]"]).experiment
    with place_for("good.mcap") as path:
        began = time.time()
        with recording.Recording(path, Plan(what), "x", case="only", seed=1, clock="real", started=began) as writer:
            for k in range(12):
                at = began + 0.1 * k
                for said in (good("KH01", k + 1), good("CF01", k + 1)):
                    writer.write(msgspec.structs.replace(said["state"][0], stamp=at))
                    writer.write(msgspec.structs.replace(said["pose"][0], stamp=at))
                    writer.write(msgspec.structs.replace(said["status"][0], stamp=at, started=began))
            writer.write(wire.Event(began, "start", "conductor", "go"))
            writer.write(wire.Contact(began + 0.5, "KH01", "CF01", 0.1, 0.01))
            writer.write(msgspec.structs.replace(of_all()[KEYS.world][0], stamp=began))
            for stamp, lies in ((began, 0.2), (began + 1.0, 0.21)):
                writer.write(wire.HostClock("lab1", stamp, lies, 0.001, ["KH01"]))
            writer.write(wire.Event(began + 1.0, "phase", "conductor", "landing"))
        return path.read_bytes()


def unpacked(data):
    """The same recording, neither compressed nor guarded by checksums."""
    plain = RecordBuilder()
    for record in StreamReader(io.BytesIO(data)).records:
        record.write(plain)
    return MCAP0_MAGIC + plain.end() + MCAP0_MAGIC


def resealed(data):
    """The checksums of attachments made good again, so that what was changed in them is looked at."""
    made, at = bytearray(data), 8
    while at + 9 <= len(made):
        opcode, length = struct.unpack_from("<BQ", made, at)
        end = at + 9 + length
        if end > len(made) or length < 4:
            break
        if opcode == 0x09:
            made[end - 4 : end] = zlib.crc32(made[at + 9 : end - 4]).to_bytes(4, "little")
        at = end
    return bytes(made)


def recordings(examples, as_read):
    """A recording is read, analysed and recovered."""
    with place_for("some.mcap") as file:
        target = file.with_name("other.mcap")

        def take(data):
            file.write_bytes(as_read(data))
            if len(data) % 4 == 0:
                target.unlink(missing_ok=True)
                with suppress(RecordingError):
                    recover(file, target)
            assert len(playback.read(file).trace.time) <= 100_000

        yield Target(examples, take, (RecordingError,))


@place(10_000, 60)
def damaged_recording():
    """As the disk may leave it."""
    data = recording_of_a_second()
    return recordings([data, data[: len(data) // 2]], bytes)


@place(10_000, 60)
def forged_recording():
    """Its checksums made good."""
    return recordings([unpacked(recording_of_a_second())], resealed)


@place(10_000)
def run_files():
    """`run.json`, `metrics.json` and the experiment file of a past run: what cannot be read is not known."""
    origin = {"command": "zenpark run a.toml", "file": "a.toml", "begun": 1e9, "tags": ["a"], "changes": ["seed=3"]}
    figures = [{"case": "a", "seed": 1, "mean": {"f_hz": 2.5, "iae": None}}]
    example = b"\0".join([json.dumps(origin).encode(), json.dumps(figures).encode(), b"title = 'A'\nx = [1, 2]\n"])
    with place_for(SOURCE) as file:
        (file.parent / "good").mkdir()
        (file.parent / "good" / SOURCE).write_text("title = 'B'")
        (file.parent / "good" / ORIGIN).write_text(json.dumps(origin))

        def take(data):
            for name, part in zip((ORIGIN, METRICS, SOURCE), (*data.split(b"\0", 2), b"", b""), strict=False):
                (file.parent / name).write_bytes(part)
            found = past_runs([file.parent])
            for run in found:
                run.matches(["a", "b"])
                differences(found[0], run)

        yield Target([example], take)


@place(10_000)
def bundles():
    """Archives of runs: damaged and forged ones are refused, and nothing is written outside of their folder."""
    parts = {ORIGIN: b'{"file": "a.toml"}', SOURCE: b"title = 'A'\n"}
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in parts.items())
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in {**parts, "SHA256SUMS": sums.encode()}.items():
            archive.writestr(name, data)
    with place_for("bundle.zip") as file:

        def take(data):
            file.write_bytes(data)
            into = file.parent / "into"
            try:
                bundle.unpack(file, into)
            finally:
                shutil.rmtree(into, ignore_errors=True)
                assert [left.name for left in file.parent.iterdir()] == [file.name]

        yield Target([packed.getvalue()], take, (RecordingError,))


@place(30_000)
def sweep_runs():
    """`runs.jsonl` and `origin.json` of a sweep: lines that cannot be read are counted, not fatal."""
    kinds = {int: 1, float: 0.5, bool: True, str: "x"}
    blank = {field.name: kinds.get(field.type) for field in msgspec.structs.fields(RunMetrics)}
    blank |= {"values": {"iae": 0.5}, "metric_faults": []}
    line = json.dumps({"cell": "c", "code": "d", "runs": [blank], "failed": {"3": "why"}}).encode() + b"\n"
    with place_for(RUNS) as file:

        def take(data):
            runs, _, origin = data.partition(b"\0")
            file.write_bytes(runs)
            (file.parent / store.ORIGIN).write_bytes(origin)
            with Store(file.parent) as kept:
                kept.known("c", "d")
                kept.changed_since(StoreOrigin("1", "2", "3"))

        yield Target([line * 2 + b'\0{"version":"1","code":"2","file":"3"}', line + line[:30]], take, (DocumentError,))


@place(6_000, 30)
def sweep_arguments():
    """Axes and seeds, one a line."""
    read = document.read("triangle")
    lines = [
        "trigger.threshold=0.002:0.05:log5", "formation.gain=2:4:lin3", "trigger.kind=mixed,relative", "seeds=5",
        "seeds=101:150", "tuning=1001:1010", 'formation.links."KH01 - KH02"=0.4,0.5', "formation.gain=1,2,3",
    ]  # fmt: skip
    examples = [line.encode() for line in lines] + [b"\n".join([lines[1].encode(), lines[3].encode()])]

    @refusing_well
    def take(data):
        axes, words = arguments(data.decode("utf-8", "surrogateescape").split("\n")[:4])
        seeds_of(words.get("seeds"), 1)
        seeds_of(words.get("tuning"), 1001)
        few = [replace(axis, values=axis.values[:2]) for axis in axes[:2]]
        cells(read, "triangle", [], few, [])

    yield Target(examples, take, (DocumentError,))


WORDS = """
endpoint tcp/127.0.0.1:7447
endpoint tls/[::1]:7447?a=b#c
endpoint unixsock-stream//tmp/x
crazyflie radio://0/80/2M/E7E7E7E701
crazyflie udp://127.0.0.1:19850
khepera khepera4://10.0.0.1:50000?server=fork
khepera kteam:///dev/ttyS0
tello tello://192.168.10.1:8889
turtlebot ros2dds://tb3_0?distro=humble
turtlebot rmw://tb3_0?domain=0&distro=jazzy
vicon 10.0.0.2:801
faults {"occluded_from_s": 5, "loss": 0.1}
device {"server":"2025-05","poll_hz":10}
device {"positioning":{"system":"loco","anchors":[[0,0,1]]}}
device {"control":"position","log_hz":50,"parameters":{"a.b":1}}
key park/*/pose
plugin mixed
link A > B
park d 10.0 0.5
"""


@place(60_000, 400)
def words():
    """Addresses, endpoints, settings of devices, faults, key expressions: kind and text with a zero byte between."""
    kinds = (crazyflie.CrazyflieSettings, khepera4.Khepera4Settings, tello.TelloSettings, turtlebot3.TurtleBot3Settings)

    def device(text):
        table = msgspec.json.decode(text) if text.count("[") + text.count("{") < 500 else {}
        for kind in kinds:
            with suppress(BodyError):
                settings(kind, "R1", table if isinstance(table, dict) else {})

    with place_for("stations.yaml") as file:

        def lighthouse(text):
            file.write_bytes(text.encode("utf-8", "surrogatepass"))
            stations(str(file), 4)

        read = {
            "endpoint": lambda text: sessions.config(sessions.settings("client", connect=[text], listen=[text])),
            "crazyflie": partial(crazyflie.address, "R1"),
            "khepera": partial(KheperaAddress.parse, "R1"),
            "tello": partial(tello.endpoint, "R1"),
            "turtlebot": lambda text: turtlebot3.address("R1", text, turtlebot3.TurtleBot3Settings()),
            "vicon": partial(parse_server, port=801),
            "faults": partial(msgspec.json.decode, type=Faults),
            "device": device,
            "key": key_expression,
            "plugin": partial(registry.struct, registry.TRIGGERS),
            "link": link_pairs,
            "park": lambda text: khepera4.scanned(text) + khepera4.numbers(text),
            "stations": lighthouse,
        }
        examples = [line.replace(" ", "\0", 1).encode() for line in WORDS.strip().splitlines()]
        examples.append(b"stations\0type: lighthouse_system_configuration\nversion: '1'\nsystemType: 2\ngeos:\n  0:\n"
                        b"    origin: [0, 0, 1]\n    rotation: [[1,0,0],[0,1,0],[0,0,1]]\ncalibs: {}\n")  # fmt: skip
        names = list(read)

        def take(data):
            name, rest = split(data)
            read[name if name in read else names[len(data) % len(names)]](rest.decode("utf-8", "surrogateescape"))

        yield Target(examples, take, (ExplainedError, argparse.ArgumentTypeError, msgspec.MsgspecError, ValueError))
