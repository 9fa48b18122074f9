"""A whole run in real time, through the command line."""

import contextlib
import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from experiments.recording import playback
from experiments.recording.reader import RecordingError
from experiments.run import reopen
from tests.system.lab import NEAR_TRIANGLE, ROOT, Flight, assert_formed, gone, typed, until

pytestmark = pytest.mark.system

EVENT = ("--case", "event", "--json")
COURSE = ROOT / "docs" / "course"
LAW = "formation.law=solutions/01_rendezvous.py:Meet"


class Whole(NamedTuple):
    """A run that nothing disturbed."""

    folder: Path
    code: int
    out: str
    said: str


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    flight = Flight(folder, "triangle", *EVENT, *NEAR_TRIANGLE, "duration_s=2", report=True)
    code, out = flight.finish(90.0)
    return Whole(folder, code, out, flight.said())


@pytest.mark.mechanism("run")
def test_a_run_forms_up_loses_nothing_and_reports(whole):
    folder = whole.folder
    assert whole.code == 0, whole.said
    document = json.loads(whole.out)
    assert document["run"] == str(folder)
    assert list(document["cases"]) == ["event"]
    figures = "f_hz messages bytes iae itae updates rmse acquired_s lost dropped missed_deadlines"
    for robot in document["cases"]["event"]["robots"].values():
        assert robot.keys() == set(figures.split())
        assert robot["lost"] == 0
        assert robot["acquired_s"] is not None
    for name in ("report.html", "metrics.json", "metrics.csv", "experiment.toml"):
        assert (folder / name).stat().st_size > 100

    read = playback.read(folder / "event.mcap")
    assert read.complete
    assert not read.trace.lost.any()
    assert np.isfinite(read.trace.true_position).all(axis=(1, 2)).mean() > 0.99


def test_a_recording_opens_elsewhere_with_typed_messages(whole):
    file = whole.folder / "event.mcap"
    with AnyReader([file]) as bag:
        types = {connection.topic: connection.msgtype for connection in bag.connections}
        assert types["/CF01/true_pose"] == "geometry_msgs/msg/PoseStamped"
        connection = next(c for c in bag.connections if c.topic == "/CF01/state")
        heights = [
            bag.deserialize(raw, connection.msgtype).true_position[2] for _, _, raw in bag.messages([connection])
        ]
    assert max(heights) == pytest.approx(0.3, abs=0.05)
    poses = typed(file, "/KH01/true_pose")
    assert poses[0].header.frame_id == "map"
    assert abs(poses[-1].pose.position.x) < 2.0
    with file.open("rb") as stream:
        reader = make_reader(stream)
        names = [attachment.name for attachment in reader.iter_attachments()]
    assert {"experiment.toml", "experiment.json"} <= set(names)


class Begun:
    """A run of the triangle, in flight."""

    def __init__(self, folder, *words):
        self.flight, self.file = Flight(folder / "run", "triangle", *EVENT, *words), folder / "run" / "event.mcap"
        self.flight.until_flown()
        self.children = self.flight.children()

    def finish(self, code):
        """Results of the robots; no process is left."""
        ended, out = self.flight.finish()
        assert ended == code, self.flight.said()
        assert gone(list(self.children.values()))
        return json.loads(out)["cases"]["event"]["robots"]


def test_killed_follower_is_missed_and_others_go_on(tmp_path):
    begun = Begun(tmp_path, "duration_s=4")
    begun.children["KH02"].kill()
    begun.flight.until_said(r"lost KH02: its process ended \(killed by SIGKILL\)")
    assert begun.finish(1)["CF01"]["messages"] > 0
    failed = r"zenpark: Failed in event: KH02 at \d.\d s: was lost: its process ended"
    assert re.search(failed, begun.flight.said())
    read = playback.read(begun.file)
    assert read.complete
    end = {event.source: event.text for event in read.trace.events if event.kind == "robot"}
    assert (end["CF01"], end["KH01"]) == ("done: finished", "done: finished")
    assert list(typed(begun.file, "/KH01/status")[-1].missing) == ["KH02"]


def test_formation_holds_without_zygote_and_router(tmp_path):
    """The router comes back."""
    begun = Begun(tmp_path, "duration_s=8")
    for name in ("zygote", "router"):
        begun.children[name].kill()
        begun.flight.until_said(rf"the {name} ended \(killed by SIGKILL\)")
    begun.flight.until_said(r"the router ended \(killed by SIGKILL\); started again")
    begun.finish(0)
    assert "lost" not in begun.flight.said()
    read = playback.read(begun.file)
    assert read.complete
    assert_formed(read.trace, 0.05, since_s=7.0)


def test_killed_recorder_is_replaced_and_fails_the_run(tmp_path):
    begun = Begun(tmp_path, "duration_s=4")

    def recorded():
        """Poses of the last robot in the run are in the file."""
        with contextlib.suppress(RecordingError):
            return len(playback.read(begun.file).trace.sent_by(2)) > 0
        return False

    until(recorded, "poses are recorded")
    begun.flight.children()["recorder"].kill()
    assert begun.finish(1)["CF01"]["messages"] > 0
    assert "zenpark: failed: event: the recorder ended (killed by SIGKILL); started again" in begun.flight.said()
    read = playback.read(begun.file)
    assert read.complete, "the parts are joined"
    assert not np.isnan(read.trace.position[[0, -1]]).any(), "both recorders have recorded"
    assert list(begun.flight.folder.glob("cases/event/*.mcap")) == []


def test_unstartable_robot_ends_run_as_the_file_says(tmp_path):
    absent = (*EVENT, "robots.CF01.body=udp://127.0.0.1:9", "duration_s=4")
    flight = Flight(tmp_path / "abort", "triangle", *absent)
    flight.until_said(r"CF01: could not start; nothing has moved")
    said = flight.said()
    for once in ("is the simulation running there?", "could not start", "start.missing = 'go-on'"):
        assert said.count(once) == 1
    assert "Traceback" not in said
    assert flight.finish()[0] == 2
    flight = Flight(tmp_path / "go-on", "triangle", *absent, "start.missing=go-on", "start.deadline_s=3")
    code, out = flight.finish()
    assert code == 1
    assert "zenpark: Failed in event: CF01 " in flight.said()
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert robots["KH01"]["messages"] > 5, "the others fly"
    assert robots["CF01"]["messages"] == 0


@pytest.mark.timeout(150)
@pytest.mark.parametrize(("changes", "passed"), [((), False), ((LAW, "criteria.0.at_most=0.6"), True)])
def test_a_run_in_real_time_is_judged(changes, passed, tmp_path):
    """By criteria, with a law and metrics in files beside the experiment."""
    file, out = str(COURSE / "01-rendezvous.toml"), tmp_path / "run"
    flight = Flight(out, file, *changes, "duration_s=6", "--json", report=True)
    code, text = flight.finish(120.0)
    found = json.loads(text)
    assert found["passed"] is passed, flight.said()
    assert code == (0 if passed else 1), flight.said()
    assert ("Passed: 2 of 2" if passed else "The robots are to meet") in (out / "report.html").read_text("utf-8")
    assert (out / "measures.py").is_file()
    assert (out / LAW.partition("=")[2].partition(":")[0]).is_file() is passed
    assert reopen(out).summary()["passed"] is passed
