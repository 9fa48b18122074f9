"""Others read a recording; nothing is written over, and a full disk or a mistake leaves a file that can be read."""

import errno
import io
import itertools
import math

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from agents.network.messages import Event
from bridges import ros2 as bridge
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.recording import writer
from experiments.recording.playback import read
from experiments.recording.reader import RecordingError, recover
from experiments.recording.ros2 import viewers
from experiments.recording.topics import CHUNK_BYTES
from experiments.scene import markers
from tests.experiments import recordings as rec
from tests.waiting import ManualClock


def test_what_is_attached(path):
    rec.write(path, rec.begun(), started=rec.START)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        attached = {one.name: one.data for one in reader.iter_attachments()}
        about = {one.name: one.metadata for one in reader.iter_metadata()}["zenpark"]
    assert attached["experiment.toml"].decode() == rec.DOCUMENT
    assert msgspec.json.decode(attached["experiment.json"], type=Experiment) == rec.PAIR
    known = {"case": "only", "seed": "4", "clock": "real", "started": repr(rec.START)}
    assert about.items() > known.items()
    assert about["version"]


def decoded(path, topics=None):
    """Messages of a recording, as another library reads them."""
    with path.open("rb") as file:
        return list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics))


def test_others_read_it(path):
    rec.write(path, *rec.whole_run())
    with AnyReader([path]) as reader:
        seen = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    states = [message for topic, _, message in seen if topic == "/CF01/state"]
    assert [message.seq for message in states] == list(range(1, 12))
    (receipt,) = states[5].received
    assert (receipt.sender, receipt.position.tolist()) == ("TB01", [0.45, 0.0, 0.0])
    t, drawn = [(t, message) for topic, t, message in seen if topic == "/TB01/true_pose"][3]
    assert (t, drawn.header.frame_id, drawn.pose.position.z) == (round((rec.START + 0.3) * 1e9), "map", 0.01)
    measured = [message for topic, _, message in seen if topic == "/CF01/true_pose"]
    assert measured[3].pose.position.x == -0.3

    found = decoded(path)
    assert len(found) == len(seen)
    sent = [(one.decoded_message, one.message) for one in found if one.channel.topic == "/TB01/pose"]
    assert [message.sequence for _, message in sent] == list(range(1, 12))
    content, message = sent[2]
    assert (content.seq, content.size, content.received) == (3, 150, rec.START + 0.2 + 0.002)
    assert message.log_time == round((rec.START + 0.2 + 0.002) * 1e9)
    assert message.publish_time == round((rec.START + 0.2) * 1e9)
    last = [one.decoded_message for one in found if one.channel.topic == "/CF01/status"][-1]
    assert (last.lost_keys, last.lost_values, math.isnan(last.battery)) == (["TB01"], [1], True)


def test_a_recording_is_never_overwritten(path):
    path.write_text("precious")
    with pytest.raises(RecordingError, match=r"run\.mcap: exists already; move it away"):
        rec.write(path)
    assert path.read_text() == "precious"
    with pytest.raises(RecordingError, match="cannot be created: No such file"):
        rec.write(path.parent / "none" / "run.mcap")


def test_callers_error_leaves_a_finished_file(path):
    made = rec.recording(path)

    def fails():
        with made:
            rec.put(made, rec.whole_run())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fails()
    assert read(path).complete
    made.close()
    with pytest.raises(RecordingError, match="closed"):
        made.write(rec.state())


def test_a_full_disk_keeps_what_was_written(path):
    messages = rec.scattered(2000)
    made = rec.recording(path)
    with rec.small_disk():
        with pytest.raises(RecordingError, match=r"run\.mcap: cannot be written: .*zenpark recover"):
            rec.put(made, [rec.begun(), *messages])
        with pytest.raises(RecordingError, match="make room"):
            made.write(messages[0])
        made.close()
    assert path.stat().st_size == 40_000
    playback = read(path)
    assert not playback.complete
    assert playback.messages > 200
    np.testing.assert_allclose(playback.trace.position[0, 0], messages[0].position, atol=1e-3)


def test_disk_too_full_for_record_or_recovery(path, tmp_path, monkeypatch):
    big = rec.broken(tmp_path / "big.mcap", rec.begun(), *rec.scattered(2000))
    with rec.small_disk():
        with pytest.raises(RecordingError, match=r"run\.mcap: cannot be written"):
            recover(big, path)
        assert not path.exists()
        with pytest.raises(RecordingError, match="cannot be written"):
            rec.recording(tmp_path / "long.mcap", document="#" * 50_000)
    monkeypatch.setattr(writer, "TemporaryFile", raising(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(RecordingError, match="No space left"):
        rec.write(path, *rec.whole_run())
    assert not path.exists()


def raising(error):
    def act(*_, **__):
        raise error

    return act


def test_interrupt_inside_a_write_ends_all_writing(path, monkeypatch):
    made = rec.recording(path)
    monkeypatch.setattr(writer.McapFile, "flush", raising(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        made.flush()
    with pytest.raises(RecordingError, match=r"interrupted while it wrote; run `\./zenpark recover`"):
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


def drawn_scene(path):
    """Write the pair's recording with a scene, states out of order by 0.15 s, and an event from the future."""
    clock = ManualClock(rec.START)
    with rec.recording(path, draw=markers.drawing(Plan(rec.PAIR)), utc=clock.utc) as made:
        made.write(Event(rec.START + 5.0, "start", "conductor", "common start"))
        for k in range(300):
            clock.now = rec.START + 0.05 * k + 0.2
            for robot, late in (("TB01", 0.0), ("CF01", 0.15)):
                made.write(rec.state(robot, seq=k + 1, at=0.05 * k + 0.2 - late, x=0.01 * k))
            if k % 20 == 7:
                made.write(Event(clock.now - 0.5, "robot", "CF01", "said late"))


def test_viewers_find_frames_and_scene_in_standard_types(path):
    drawn_scene(path)
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
    assert len(decoded(path, ["/tf", "/scene"])) == len(frames) + len(scenes)


def test_size_of_chunks_changes_no_message(tmp_path):
    counts, found = [], []
    for size in (1_000, CHUNK_BYTES, 1_000_000):
        file = tmp_path / f"{size}.mcap"
        with rec.recording(file, chunk_bytes=size) as made:
            rec.put(made, [rec.state("CF01", k, rec.START + 0.02 * k) for k in range(200)])
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            found.append([(channel.topic, message) for _, channel, message in reader.iter_messages()])
            counts.append(len(reader.get_summary().chunk_indexes))
    assert counts[0] > counts[1] > counts[2] == 1
    assert found[0] == found[1] == found[2]


def test_chunks_are_in_order_of_time(path):
    drawn_scene(path)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        first, *_ = [m for *_, m in make_reader(file).iter_messages(["/events"])]
    assert len(chunks) > 10
    for before, after in itertools.pairwise(chunks):
        assert before.message_end_time <= after.message_start_time
    assert first.log_time == round(rec.START * 1e9), "logged when it came"
    assert first.publish_time == round((rec.START + 5.0) * 1e9)
