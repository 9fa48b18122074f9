"""A whole run in real time, through the command line."""

from __future__ import annotations

import contextlib
import json
import re
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from experiments.recording import playback
from experiments.recording.reader import RecordingError
from tests.system.lab import NEAR_TRIANGLE, Flight, Watcher, gone, typed, until

pytestmark = pytest.mark.system

SHORT = ("--set", "duration_s=4")


@dataclass
class Whole:
    """A run that nothing disturbed."""

    folder: Path
    code: int
    out: str
    said: str


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    folder = tmp_path_factory.mktemp("whole") / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--json", *NEAR_TRIANGLE, "--set", "duration_s=2")
    code, out = flight.finish(90.0)
    return Whole(folder, code, out, flight.said())


@pytest.mark.mechanism("run")
def test_a_run_forms_up_loses_nothing_and_reports(whole: Whole) -> None:
    folder = whole.folder
    assert whole.code == 0, whole.said
    document = json.loads(whole.out)
    assert document["run"] == str(folder)
    assert list(document["cases"]) == ["event"]
    for case in document["cases"].values():
        for robot in case["robots"].values():
            assert robot["lost"] == 0
            figures = "f_hz messages bytes iae itae updates rmse acquired_s lost dropped missed_deadlines"
            assert robot.keys() == set(figures.split())
            assert robot["acquired_s"] is not None
    for name in ("report.html", "metrics.json", "metrics.csv", "experiment.toml"):
        assert (folder / name).stat().st_size > 100

    read = playback.read(folder / "event.mcap")
    assert read.complete
    assert not read.trace.lost.any()
    assert np.isfinite(read.trace.true_position).all(axis=(1, 2)).mean() > 0.99


def test_a_recording_opens_elsewhere_with_typed_messages(whole: Whole) -> None:
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


def test_ctrl_c_lands_everybody_and_leaves_valid_recording(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--no-report")
    flight.until_said(r"phase conductor: formation")
    robots = list(flight.children().values())
    flight.signal(signal.SIGINT)
    code, _ = flight.finish()
    assert code == 130
    assert gone(robots)
    read = playback.read(folder / "event.mcap")
    assert read.complete
    with (folder / "event.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary() is not None
    assert typed(folder / "event.mcap", "/CF01/status")[-1].phase == "done"


def test_killed_follower_is_missed_and_others_go_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--json", "--no-report", *SHORT)
    flight.until_said(r"phase conductor: formation")
    everyone = list(flight.children().values())
    flight.children()["KH02"].kill()
    flight.until_said(r"lost KH02: its process ended \(killed by SIGKILL\)")
    code, out = flight.finish()
    assert code == 1
    assert re.search(r"zenpark: Failed in event: KH02 at \d.\d s: was lost: its process ended", flight.said())
    assert gone(everyone)
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert robots["CF01"]["messages"] > 0
    read = playback.read(folder / "event.mcap")
    assert read.complete
    end = {event.source: event.text for event in read.trace.events if event.kind == "robot"}
    assert end["CF01"] == "done: finished"
    assert end["KH01"] == "done: finished"
    assert list(typed(folder / "event.mcap", "/KH01/status")[-1].missing) == ["KH02"]


def test_robots_fly_on_without_their_zygote(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--no-report", *SHORT)
    flight.until_said(r"phase conductor: formation")
    everyone = list(flight.children().values())
    flight.children()["zygote"].kill()
    flight.until_said(r"zygote conductor: the zygote ended \(killed by SIGKILL\)")
    code, _ = flight.finish()
    assert code == 0, flight.said()
    assert "lost" not in flight.said()
    assert gone(everyone)


def test_killed_router_comes_back_and_formation_holds(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--json", "--no-report", "--set", "duration_s=8")
    flight.until_said(r"phase conductor: formation")
    everyone = list(flight.children().values())
    flight.children()["router"].kill()
    flight.until_said(r"the router ended \(killed by SIGKILL\); started again")
    code, _ = flight.finish()
    assert code == 0
    assert gone(everyone)
    read = playback.read(folder / "event.mcap")
    assert read.complete
    trace = read.trace
    late = trace.time > 7.0
    p = trace.true_position[late]
    sides = [np.linalg.norm(p[:, i] - p[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2))]
    wanted = trace.plan.experiment.formation.links.values()
    for side, link in zip(sides, wanted, strict=True):
        target = link if isinstance(link, float) else link.distance
        assert np.abs(side - target).mean() < 0.05


def test_killed_conductor_leaves_no_orphan_and_readable_recording(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event")
    flight.until_said(r"phase conductor: formation")
    everyone = list(flight.children().values())
    watcher = Watcher(flight.endpoint())
    try:
        watcher.until(lambda: {watcher.phase(n) for n in ("KH01", "KH02", "CF01")} == {"running"}, "all running")
        watcher.until(lambda: "CF01" in watcher.state, "it tells where it is")
        begun = watcher.state["CF01"].stamp
        watcher.until(lambda: watcher.state["CF01"].stamp > begun + 1.0, "a second of the experiment")
        flight.signal(signal.SIGKILL)
        flight.finish()
        watcher.until(lambda: {watcher.phase(n) for n in ("KH01", "KH02", "CF01")} == {"done"}, "all down")
        assert watcher.status["CF01"].reason == "the starter is gone"
        assert watcher.state["CF01"].true_position is not None
        assert watcher.state["CF01"].true_position[2] < 0.03
    finally:
        watcher.close()
    until(lambda: gone(everyone), "no orphan")
    read = playback.read(folder / "event.mcap")
    assert read.complete
    assert len(read.trace.time) > 40, "a second at 50 Hz"


def test_killed_recorder_is_replaced_and_fails_the_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", "--json", *SHORT)
    flight.until_said(r"event: phase conductor: formation")

    def recorded() -> bool:
        """Poses of the last robot in the run are in the file."""
        with contextlib.suppress(RecordingError):
            return len(playback.read(folder / "event.mcap").trace.sent_by(2)) > 0
        return False

    until(recorded, "poses are recorded")
    flight.children()["recorder"].kill()
    code, out = flight.finish()
    assert code == 1
    assert "zenpark: failed: event: the recorder ended (killed by SIGKILL); started again" in flight.said()
    assert json.loads(out)["cases"]["event"]["robots"]["CF01"]["messages"] > 0
    read = playback.read(folder / "event.mcap")
    assert read.complete, "the parts are joined"
    assert not np.isnan(read.trace.position[[0, -1]]).any(), "both recorders have recorded"
    assert list(folder.glob("cases/event/*.mcap")) == []


def test_unstartable_robot_ends_run_as_the_file_says(tmp_path: Path) -> None:
    absent = (
        "--case", "event", "--json", "--no-report",
        "--set", "robots.CF01.body=udp://127.0.0.1:9", "--set", "duration_s=4",
    )  # fmt: skip
    flight = Flight(tmp_path / "abort", "triangle", *absent)
    flight.until_said(r"CF01: could not start; nothing has moved")
    said = flight.said()
    for once in ("is the simulation running there?", "could not start", "start.missing = 'go-on'"):
        assert said.count(once) == 1
    assert "Traceback" not in said
    assert flight.finish()[0] == 2
    flight = Flight(
        tmp_path / "go-on", "triangle", *absent, "--set", "start.missing=go-on", "--set", "start.deadline_s=3"
    )
    code, out = flight.finish(60.0)
    assert code == 1
    assert "zenpark: Failed in event: CF01 " in flight.said()
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert robots["KH01"]["messages"] > 5, "the others fly"
    assert robots["CF01"]["messages"] == 0
