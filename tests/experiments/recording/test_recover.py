"""A recording is read also when its recorder was killed or the file is damaged, and can be made whole."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from agents.network.messages import Event, Pose
from experiments.recording.playback import read
from experiments.recording.reader import RecordingError, Recovered, recover
from tests.cases import examples
from tests.experiments.recordings import DOCUMENT, begun, broken, scattered, whole_run, write
from tools.commands import results as commands

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
    root = Path(__file__).parents[3]
    command = [sys.executable, "-c", KILLED.format(path=str(path))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=root) as process:
        assert process.stdout.readline() == "flushed\n"
        process.kill()
    before, playback = path.read_bytes(), read(path)
    assert not playback.complete
    assert playback.messages >= 60
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


def test_recovery_keeps_everything(path, tmp_path):
    target = tmp_path / "whole.mcap"
    assert recover(broken(path), target) == Recovered(82, ("TB01", "CF01"), complete=False)
    with target.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert (reader.get_header().profile, reader.get_header().library) == ("ros2", "zenpark")
        assert {one.name: one.data for one in reader.iter_attachments()}["experiment.toml"].decode() == DOCUMENT
        assert [one.metadata["case"] for one in reader.iter_metadata()] == ["only"]
        summary = reader.get_summary()
    of_robots = {f"/{robot}/{what}" for robot in ("TB01", "CF01") for what in ("state", "true_pose", "status")}
    assert {channel.topic for channel in summary.channels.values()} == {"/events", "/tf", "/TB01/pose", *of_robots}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    with AnyReader([target]) as reader:
        assert len(list(reader.messages())) == summary.statistics.message_count == 82


def test_a_whole_file_needs_no_recovery(path, tmp_path, capsys):
    write(path, *whole_run())
    assert recover(path, tmp_path / "whole.mcap") == Recovered(82, ("TB01", "CF01"), complete=True)
    commands.recover(str(path), None)
    assert capsys.readouterr().out == f"{path} is whole already: 82 messages of TB01, CF01\n"
    assert sorted(tmp_path.iterdir()) == [path]


def test_recovery_overwrites_nothing(path, tmp_path):
    target = tmp_path / "precious"
    target.write_text("mine")
    for into in (target, broken(path)):
        with pytest.raises(RecordingError, match=f"{into.name}: exists already"):
            recover(path, into)
    assert target.read_text() == "mine"
    assert not read(path).complete


def test_a_recorder_that_took_over_completes_the_recording(path, tmp_path, capsys):
    """The first messages of the second recorder are the last values and the events that publishers repeat."""
    run = sorted(whole_run(), key=lambda message: message.stamp)
    first, rest = run[:50], run[50:]
    events, poses = ([each for each in first if isinstance(each, kind)] for kind in (Event, Pose))
    assert events
    broken(path, *first)
    later = path.parent / "cases" / path.stem / "part2.mcap"
    later.parent.mkdir(parents=True)
    write(later, *events, poses[-1], *rest)
    (later.parent / "part3.mcap").touch()  # killed before its first record
    commands.recover(str(path), None)
    write(whole := tmp_path / "whole.mcap", *run)
    target = path.with_name("run-recovered.mcap")
    made, wanted = read(target), read(whole)
    assert (made.complete, made.messages) == (True, wanted.messages)
    assert capsys.readouterr().out == f"{target}: {82 + len(events) + 1} messages of TB01, CF01\n"
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
    for size in range(0, len(recorded), 61):
        path.write_bytes(recorded[:size])
        found.append(survives(path, tmp_path / "target.mcap") or 0)
    assert found == sorted(found)
    assert (found[0], found[-1]) == (0, 82)


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
    content[recorded.rindex(b"string robot")] = content[-1] = 0  # not finished
    path.write_bytes(content)
    assert survives(path, tmp_path / "target.mcap") == 82


def test_a_damaged_chunk_costs_only_itself(path):
    write(path, begun(), *scattered(2000))
    whole = read(path)
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    content = bytearray(path.read_bytes())
    content[chunks[2].chunk_start_offset + chunks[2].chunk_length // 2] ^= 0xFF
    path.write_bytes(content)
    playback = read(path)
    assert not playback.complete
    assert whole.messages - 200 < playback.messages < whole.messages
