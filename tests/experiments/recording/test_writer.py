"""Others read a recording; a full disk, a mistake or a kill leaves one that can be read, and be made whole."""

import errno
import io
import itertools
import re
import subprocess
import sys
from collections import Counter
from fractions import Fraction
from functools import reduce
from operator import add
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from agents.network.messages import Event, HostClock, Pose, PoseReceipt, State, encode
from bridges.ros2 import bridge
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.recording import writer
from experiments.recording.playback import read
from experiments.recording.reader import RecordingError, Records, Recovered, recover
from experiments.recording.ros2 import viewers
from experiments.recording.topics import CHUNK_BYTES
from experiments.run import reopen
from experiments.scene import markers
from tests.cases import examples
from tests.commands import ROOT
from tests.experiments import recordings as rec
from tests.waiting import ManualClock
from tools.commands import results as commands


def test_what_is_attached_stays_in_a_recovered_recording(path, tmp_path):
    made, target = tmp_path / "made.mcap", tmp_path / "whole.mcap"
    rec.write(made, *rec.whole_run(), started=rec.START)
    path.write_bytes(made.read_bytes()[:-1])
    assert recover(path, target) == Recovered(82, ("TB01", "CF01"), complete=False)
    for each in (made, target):
        with each.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert (reader.get_header().profile, reader.get_header().library) == ("ros2", "zenpark")
            attached = {one.name: one.data for one in reader.iter_attachments()}
            (about,) = (one.metadata for one in reader.iter_metadata() if one.name == "zenpark")
            summary = reader.get_summary()
        assert attached["experiment.toml"].decode() == rec.DOCUMENT
        assert msgspec.json.decode(attached["experiment.json"], type=Experiment) == rec.PAIR
        assert about.items() > {"case": "only", "seed": "4", "clock": "real", "started": repr(rec.START)}.items()
        assert about["version"]
        of_robots = {f"/{robot}/{what}" for robot in ("TB01", "CF01") for what in ("state", "true_pose", "status")}
        assert {channel.topic for channel in summary.channels.values()} == {"/events", "/tf", "/TB01/pose", *of_robots}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        with AnyReader([each]) as reader:
            assert len(list(reader.messages())) == summary.statistics.message_count == 82


def test_others_read_it(path):
    rec.write(path, *rec.whole_run())
    with AnyReader([path]) as reader:
        seen = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    states = [message.data.encode() for topic, _, message in seen if topic == "/CF01/state"]
    assert states == [encode(each) for each in rec.whole_run() if isinstance(each, State) and each.robot == "CF01"]
    t, drawn = [(t, message) for topic, t, message in seen if topic == "/TB01/true_pose"][3]
    assert (t, drawn.header.frame_id, drawn.pose.position.z) == (nanoseconds(0.3), "map", 0.01)
    measured = [message for topic, _, message in seen if topic == "/CF01/true_pose"]
    assert measured[3].pose.position.x == -0.3

    with path.open("rb") as file:
        found = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(found) == len(seen)
    sent = [(one.decoded_message, one.message) for one in found if one.channel.topic == "/TB01/pose"]
    assert [message.sequence for _, message in sent] == list(range(1, 12))
    content, message = sent[2]
    assert content.data.startswith('{"robot":"TB01","seq":3,')
    assert (message.log_time, message.publish_time) == (nanoseconds(0.2, 0.002), nanoseconds(0.2))


def nanoseconds(*at):
    """Time of the run as a file has it, exact: `playback` reads the same number back."""
    return round(Fraction(reduce(add, at, rec.START)) * 10**9)  # sum corrects its rounding from Python 3.12 on


def test_a_recording_is_never_overwritten(path, tmp_path):
    target = tmp_path / "precious"
    target.write_text("mine")
    with pytest.raises(RecordingError, match="precious: exists already; move it away"):
        rec.write(target)
    with pytest.raises(RecordingError, match="cannot be created: No such file"):
        rec.write(tmp_path / "none" / "run.mcap")
    for into in (target, rec.broken(path)):
        with pytest.raises(RecordingError, match=f"{into.name}: exists already"):
            recover(path, into)
    assert target.read_text() == "mine"
    assert not read(path).complete


def test_callers_error_leaves_a_finished_file(path):
    made = rec.recording(path)
    rec.put(made, rec.whole_run())
    assert not made.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert read(path).complete
    made.close()
    with pytest.raises(RecordingError, match="closed"):
        made.write(rec.state())


def test_a_full_disk_keeps_what_was_written(path):
    messages = rec.scattered(2000)
    made = rec.recording(path)
    with rec.small_disk():
        with pytest.raises(RecordingError, match=r"run\.mcap: cannot be written: .*zenpark export`"):
            rec.put(made, [rec.begun(), *messages])
        with pytest.raises(RecordingError, match="make room"):
            made.write(messages[0])
        made.close()
    playback = read(path)
    assert (path.stat().st_size, playback.complete, playback.messages > 200) == (40_000, False, True)
    np.testing.assert_allclose(playback.trace.position[0, 0], messages[0].position, atol=1e-3)


def test_disk_too_full_for_record_or_recovery(path, tmp_path, monkeypatch):
    big = rec.broken(tmp_path / "big.mcap", rec.begun(), *rec.scattered(2000))
    with rec.small_disk():
        with pytest.raises(RecordingError, match=r"run\.mcap: cannot be written"):
            recover(big, path)
        assert not path.exists()
        with pytest.raises(RecordingError, match="cannot be written"):
            rec.recording(tmp_path / "long.mcap", document="#" * 50_000)
    monkeypatch.setattr(writer, "TemporaryFile", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(RecordingError, match="No space left"):
        rec.write(path, *rec.whole_run())
    assert not path.exists()


def test_interrupt_inside_a_write_ends_all_writing(path, monkeypatch):
    made = rec.recording(path)
    monkeypatch.setattr(writer.McapFile, "flush", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        made.flush()
    with pytest.raises(RecordingError, match=r"interrupted while it wrote; `\./zenpark export`"):
        made.write(rec.begun())
    made.close()


def test_file_equals_the_librarys_own(tmp_path):
    plain, swift = io.BytesIO(), io.BytesIO()
    library, own = Writer(plain, chunk_size=CHUNK_BYTES), writer.McapFile(swift, tmp_path, CHUNK_BYTES)
    library.start("ros2", "zenpark")
    own.start()
    library.add_attachment(0, 0, "file", "text/plain", b"data")
    own.attach("file", "text/plain", b"data")
    library.add_metadata("about", {"case": "a"})
    own.describe("about", {"case": "a"})
    schema = library.register_schema("a", "ros2msg", b"int32 a")
    assert own.register_schema("a", "int32 a") == schema
    channels = [library.register_channel(name, "cdr", schema) for name in "ab"]
    assert [own.register_channel(name, schema) for name in "ab"] == channels
    for number in range(3000):
        message = (channels[number % 7 > 2], 1000 + (number ^ 5), bytes(number % 50), 900 + number, number)
        library.add_message(*message)
        own.add(*message)
        if own.full:
            own.flush()
    library.finish()
    own.finish()
    assert len(plain.getvalue()) > 3 * 2000
    assert swift.getvalue() == plain.getvalue()
    own.close()


def test_viewers_find_frames_and_scene_in_order(path):
    """The pair's recording with a scene, states out of order by 0.15 s, and an event from the future."""
    clock = ManualClock(rec.START)
    with rec.recording(path, draw=markers.drawing(Plan(rec.PAIR)), utc=clock.utc) as made:
        made.write(Event(rec.START + 5.0, "start", "conductor", "common start"))
        for k in range(300):
            clock.now = rec.START + 0.05 * k + 0.2
            for robot, late in (("TB01", 0.0), ("CF01", 0.15)):
                made.write(rec.state(robot, seq=k + 1, at=0.05 * k + 0.2 - late, x=0.01 * k))
            if k % 20 == 7:
                made.write(Event(clock.now - 0.5, "robot", "CF01", "said late"))
    with AnyReader([path]) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        seen = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    assert (types["/tf"], types["/scene"]) == ("tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray")
    frames = [message.transforms[0] for topic, message in seen if topic == "/tf"]
    last = [each for each in frames if each.child_frame_id == "TB01"][-1]
    assert last.header.frame_id == viewers.FRAME == bridge.FRAME
    assert (last.transform.translation.x, last.transform.rotation.w) == (2.99, 1.0)
    assert last.header.stamp.sec + 1e-9 * last.header.stamp.nanosec == pytest.approx(rec.START + 15.15, abs=1e-6)
    scenes = [message.markers for topic, message in seen if topic == "/scene"]
    assert 60 <= len(scenes) <= 76, "five a second"
    groups = {marker.ns: marker for marker in scenes[-1]}
    assert {"arena", "robots", "names", "links"} <= groups.keys()
    assert {m.header.frame_id for m in scenes[-1] if m.ns == "robots"} == {"TB01", "CF01"}
    links = groups["links"]
    assert (links.type, links.header.frame_id, len(links.colors)) == (5, "map", len(links.points))
    assert links.points[0].x == pytest.approx(2.99, abs=0.05)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        first, *_ = [m for *_, m in make_reader(file).iter_messages(["/events"])]
    assert len(chunks) > 10
    assert all(a.message_end_time <= b.message_start_time for a, b in itertools.pairwise(chunks))
    times = first.log_time, first.publish_time  # logged when it came
    assert times == (round(rec.START * 1e9), round((rec.START + 5.0) * 1e9))


KILLED = """
import itertools
from pathlib import Path
from tests.experiments.recordings import *
made = recording(Path({path!r}))
put(made, whole_run())
made.flush()
print("flushed", flush=True)
for k in itertools.count(1):
    made.write(state("CF01", 100 + k, 5.0 + k / 1000, k * 0.37))
"""


@pytest.mark.mechanism("recovery of an unfinished recording")
@pytest.mark.system
def test_a_killed_recorder_leaves_a_recording(path, tmp_path, recorded):
    command = [sys.executable, "-c", KILLED.format(path=str(path))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout.readline() == "flushed\n"
        process.kill()
    before, playback = path.read_bytes(), read(path)
    assert (playback.complete, playback.messages >= 60) == (False, True)
    target, whole = tmp_path / "whole.mcap", tmp_path / "finished.mcap"
    assert recover(path, target) == Recovered(playback.messages, ("TB01", "CF01"), complete=False)
    assert path.read_bytes() == before
    again = read(target)
    assert (again.complete, again.messages) == (True, playback.messages)
    whole.write_bytes(recorded)
    for trace in (playback.trace, again.trace):
        assert_same(trace, read(whole).trace, robots=1)


def assert_same(trace, wanted, robots=None):
    np.testing.assert_array_equal(trace.position[:, :robots], wanted.position[:, :robots])
    np.testing.assert_array_equal(trace.sent.stamp, wanted.sent.stamp)
    assert trace.lost.tolist() == wanted.lost.tolist()


def test_a_whole_file_needs_no_recovery(path, tmp_path, capsys):
    rec.write(path, *rec.whole_run())
    assert recover(path, tmp_path / "whole.mcap") == Recovered(82, ("TB01", "CF01"), complete=True)
    commands.export(str(path))
    assert capsys.readouterr().out == f"{path} is whole already: 82 messages of TB01, CF01\n"
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_recorder_that_took_over_completes_the_recording(path, tmp_path, capsys):
    """The first messages of the second recorder are the last values and the events that publishers repeat."""
    run = sorted(rec.whole_run(), key=lambda message: message.stamp)
    first, rest = run[:50], run[50:]
    events, poses = ([each for each in first if isinstance(each, kind)] for kind in (Event, Pose))
    assert events
    rec.broken(path, *first)
    later = path.parent / "cases" / path.stem / "part2.mcap"
    later.parent.mkdir(parents=True)
    rec.write(later, *events, poses[-1], *rest)
    (later.parent / "part3.mcap").touch()  # killed before its first record
    commands.export(str(path))
    rec.write(whole := tmp_path / "whole.mcap", *run)
    target = path.with_name("run-recovered.mcap")
    made, wanted = read(target), read(whole)
    assert (made.complete, made.messages) == (True, wanted.messages)
    assert capsys.readouterr().out == f"{target}: 82 messages of TB01, CF01\n"
    assert_same(made.trace, wanted.trace)


def topics(*files):
    """Number of messages by topic, over all files."""
    found = Counter()
    for file in files:
        records = Records(file)
        found.update(records.channels[message.channel].topic for message in records.messages())
    return found


def test_joining_keeps_messages_of_equal_stamps(path, tmp_path):
    """Contacts of one step, pieces of a long state, clocks and transforms out of order: all of the later part alone."""

    def second(at):
        yield from (rec.touched(at + 0.5), rec.touched(at + 0.5, "CF01", "wall"))
        yield from (clock(host, at + late) for host, late in (("lab2", 0.02), ("lab1", 0.01)))
        for k in range(20):
            for robot, late in (("TB01", 0.02), ("CF01", 0.0)):
                receipts = [PoseReceipt("TB01", k, rec.START + at + 0.01 * n, 0.0, ORIGIN, ORIGIN) for n in (1, 2)]
                yield from (rec.state(robot, k, at + k / 20 + late, received=[each]) for each in receipts)

    later = tmp_path / "part2.mcap"
    kept = [rec.begun(), rec.status(at=0.9), rec.pose(at=0.9), clock("lab1", 0.01)]
    rec.broken(path, *kept, *second(0.0))
    with rec.recording(later) as made:
        made.write(rec.pose(at=0.9), logged=rec.START + 2.0)  # a repeat has its own time of arrival
        rec.put(made, [*kept[:2], kept[3], *second(2.0)])
    found = recover(path, tmp_path / "joined.mcap", [later])
    joined, parts = topics(tmp_path / "joined.mcap"), topics(path, later)
    repeated = {"/events": 1, "/TB01/status": 1, "/TB01/pose": 1, "/run/clock": 1}
    assert dict(parts - joined) == repeated
    assert (joined["/world/contact"], joined["/CF01/state"], joined["/run/clock"]) == (4, 80, 5)
    assert found.messages == joined.total()


def clock(host, at):
    return HostClock(host, rec.START + at, 0.0, 1e-4, [])


ORIGIN = (0.0, 0.0, 0.0)


def test_a_topic_has_one_channel(path):
    rec.write(path, *rec.whole_run(), draw=markers.drawing(Plan(rec.PAIR)))
    with path.open("rb") as file:
        names = [channel.topic for channel in make_reader(file).get_summary().channels.values()]
    assert {"/tf", "/scene", "/TB01/state"} < set(names)
    assert len(names) == len(set(names))


@pytest.mark.parametrize("killed", ["before its file", "before its first record", "before its attachments"])
def test_first_recorder_may_have_recorded_nothing(path, tmp_path, killed):
    rec.write(later := tmp_path / "part2.mcap", *rec.whole_run())
    if killed != "before its file":
        path.write_bytes(later.read_bytes()[: 40 if killed == "before its attachments" else 0])
    target = tmp_path / "whole.mcap"
    assert recover(path, target, [later]).messages == 82
    made, wanted = read(target), read(later)
    assert (made.complete, made.messages) == (True, wanted.messages)
    assert_same(made.trace, wanted.trace)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "nothing was recorded"), (b"\x89MCAP", "nothing was recorded"), (b"title = 'pair'", "not an MCAP file")],
)
def test_what_is_no_recording(path, tmp_path, content, says):
    path.write_bytes(content)
    for act in (read, lambda source: recover(source, tmp_path / "target.mcap")):
        with pytest.raises(RecordingError, match=rf"run\.mcap: {says}"):
            act(path)
    assert not (tmp_path / "target.mcap").exists()
    for wrong in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(RecordingError, match="cannot be read"):
            read(wrong)


def survives(path, target):
    """Reads and recovers; whatever the damage, the only error is the named one."""
    target.unlink(missing_ok=True)
    try:
        found = recover(path, target)
    except RecordingError:
        return None
    if not found.complete:
        assert read_or_refuse(target) == read_or_refuse(path)
    return read_or_refuse(path)


def read_or_refuse(path):
    try:
        return read(path).messages
    except RecordingError:
        return None


@pytest.mark.slow
def test_a_file_cut_anywhere(path, tmp_path, recorded):
    found = []
    for size in range(0, len(recorded), 251):
        path.write_bytes(recorded[:size])
        found.append(survives(path, tmp_path / "target.mcap") or 0)
    assert (found, found[0], found[-1]) == (sorted(found), 0, 82)


@pytest.mark.slow
@examples(60)
@given(data=st.data())
def test_a_file_damaged_anywhere(tmp_path_factory, recorded, data):
    folder = tmp_path_factory.mktemp("damaged")
    damaged = bytearray(recorded)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(recorded) - 1))] = data.draw(st.integers(0, 255))
    (folder / "run.mcap").write_bytes(damaged)
    survives(folder / "run.mcap", folder / "target.mcap")


def test_first_of_contradicting_schemas_holds(path, tmp_path, recorded):
    """The summary at the end repeats them, and may be damaged."""
    content = bytearray(recorded)
    content[recorded.rindex(b"string data")] = content[-1] = 0  # not finished
    path.write_bytes(content)
    assert survives(path, tmp_path / "target.mcap") == 82


def test_a_damaged_chunk_costs_only_itself(path):
    rec.write(path, rec.begun(), *rec.scattered(2000))
    whole = read(path)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    content = bytearray(path.read_bytes())
    content[chunks[2].chunk_start_offset + chunks[2].chunk_length // 2] ^= 0xFF
    path.write_bytes(content)
    playback = read(path)
    assert (playback.complete, playback.damaged) == (False, chunks[2].chunk_length)
    assert whole.messages - 200 < playback.messages < whole.messages


# the first chunks describe the messages, and of a file that was finished its summary as well
@pytest.mark.parametrize(("chunk", "finished"), [(1, True), (3, True), (3, False), (-1, False)])
def test_zeros_over_a_border_cost_one_chunk(path, tmp_path, capsys, chunk, finished):
    """A disk lost 512 bytes: the length of what stands there is gone as well."""
    rec.write(path, rec.begun(), *rec.scattered(2000), started=rec.START)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    whole, at = read(path).messages, chunks[chunk].chunk_start_offset
    content = bytearray(path.read_bytes())
    content[at - 64 : at + 448] = bytes(512)
    path.write_bytes(content if finished else content[:-1])
    playback = read(path)
    assert whole - 400 < playback.messages < whole
    assert (playback.complete, 512 < playback.damaged < 40_000) == (False, True)
    commands.export(str(path))
    counted = f"{playback.messages} messages of TB01; {playback.damaged} bytes were damaged"
    assert counted in capsys.readouterr().out
    assert read(path.with_name("run-recovered.mcap")).messages == playback.messages


def test_a_damaged_recording_is_noted(tmp_path):
    file = tmp_path / "only.mcap"
    rec.write(file, *rec.whole_run(), *rec.scattered(2000))
    file.write_bytes(file.read_bytes()[:60_000] + bytes(20_000))
    (note,) = reopen(tmp_path).notes
    assert re.fullmatch(r"only: \d+ bytes of the recording are damaged, and what was in them is missing", note)
