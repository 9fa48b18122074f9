"""Whole runs in real time: undisturbed, with killed processes, a bad network, laws that talk, faults on purpose."""

import contextlib
import csv
import json
import re

import numpy as np
import pytest

from agents.network import messages
from experiments.recording.reader import RecordingError
from experiments.run import reopen
from tests.commands import python
from tests.runs import flown
from tests.system.lab import NEAR_TRIANGLE, ROOT, TRIANGLE, Flight, Watcher, assert_formed, gone, options, typed, until

pytestmark = pytest.mark.system

EVENT = ("--case", "event", "--json")
COURSE = ROOT / "docs" / "course"
LAW = "formation.law=solutions/01_rendezvous.py:Meet"


@pytest.mark.mechanism("run")
def test_a_run_forms_up_loses_nothing_and_reports(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", *EVENT, *NEAR_TRIANGLE, "duration_s=2", report=True)
    code, out = flight.finish(90.0)
    assert code == 0, flight.said()
    document = json.loads(out)
    assert (document["run"], list(document["cases"])) == (str(folder), ["event"])
    figures = "f_hz messages bytes iae itae updates rmse acquired_s lost dropped missed_deadlines"
    for robot in document["cases"]["event"]["robots"].values():
        assert robot.keys() == set(figures.split())
        assert robot["lost"] == 0
        assert robot["acquired_s"] is not None
    for name in ("report.html", "metrics.json", "metrics.csv", "experiment.toml"):
        assert (folder / name).stat().st_size > 100
    read = flight.read()
    assert read.complete
    assert not read.trace.lost.any()
    assert np.isfinite(read.trace.true_position).all(axis=(1, 2)).mean() > 0.99


def begun(folder, *words):
    """A run of the triangle in flight, and its processes."""
    flight = Flight(folder / "run", "triangle", *EVENT, *words)
    flight.until_flown()
    return flight, flight.children()


def trace_of(flight, processes, code):
    """Trace of a run that ends; its recording is complete, and no process is left."""
    ended, out = flight.finish()
    assert ended == code, flight.said()
    assert gone(list(processes.values()))
    assert json.loads(out)["cases"]["event"]["robots"]["CF01"]["messages"] > 0
    read = flight.read()
    assert read.complete
    return read.trace


def test_killed_follower_is_missed_and_others_go_on(tmp_path):
    flight, processes = begun(tmp_path, "duration_s=4")
    processes["KH02"].kill()
    flight.until_said(r"lost KH02: its process ended \(killed by SIGKILL\)")
    trace = trace_of(flight, processes, 1)
    assert re.search(r"zenpark: Failed in event: KH02 at \d.\d s: was lost: its process ended", flight.said())
    end = {event.source: event.text for event in trace.events if event.kind == "robot"}
    assert (end["CF01"], end["KH01"]) == ("done: finished", "done: finished")
    assert list(typed(flight.folder / "event.mcap", "/KH01/status")[-1].missing) == ["KH02"]


def test_formation_holds_without_zygote_and_router(tmp_path):
    """The router comes back."""
    flight, processes = begun(tmp_path, "duration_s=120", "timeline=[]")
    for name in ("zygote", "router"):
        processes[name].kill()
        flight.until_said(rf"the {name} ended \(killed by SIGKILL\)")
    flight.until_said(r"the router ended \(killed by SIGKILL\); started again")
    with Watcher(flight.endpoint()) as watcher:
        watcher.until(
            lambda: all((watcher.state[name].error or 1.0) < 0.03 for name in TRIANGLE), "they form up", FORMED_S
        )
    flight.interrupt()
    assert gone(list(processes.values()))
    assert ": lost " not in flight.said()
    trace = flight.read().trace
    assert_formed(trace, 0.05, since_s=trace.time[-1] - 0.5)


def test_killed_recorder_is_replaced_and_fails_the_run(tmp_path):
    flight, processes = begun(tmp_path, "duration_s=4")

    def recorded():
        """Poses of the last robot in the run are in the file."""
        with contextlib.suppress(RecordingError):
            return len(flight.read().trace.sent_by(2)) > 0
        return False

    until(recorded, "poses are recorded")
    flight.children()["recorder"].kill()
    trace = trace_of(flight, processes, 1)  # the parts are joined
    assert "zenpark: Failed in event: the recorder ended (killed by SIGKILL); started again" in flight.said()
    assert not np.isnan(trace.position[[0, -1]]).any(), "both recorders have recorded"
    assert list(flight.folder.glob("cases/event/*.mcap")) == []


def test_unstartable_robot_ends_run_as_the_file_says(tmp_path):
    absent = (*EVENT, "robots.CF01.body=udp://127.0.0.1:9", "duration_s=4")
    flight = Flight(tmp_path / "abort", "triangle", *absent)
    flight.until_said(r"CF01: could not start; nothing has moved")
    assert flight.said().count("is the simulation running there?") == 1
    assert flight.finish()[0] == 2
    flight = Flight(tmp_path / "go-on", "triangle", *absent, "start.missing=go-on", "start.deadline_s=3")
    code, out = flight.finish()
    assert code == 1
    assert "zenpark: Failed in event: CF01 " in flight.said()
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert robots["KH01"]["messages"] > 5, "the others fly"
    assert robots["CF01"]["messages"] == 0


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


BAD = ("channel.loss=0.3", "channel.delay_s=0.05")
MARGIN_S = 0.2  # what was said so shortly before the end may still be under way


def sent_and_heard(trace, listener, speaker, end):
    """Running numbers of the run that a robot said, and those of them that another one heard."""
    said = trace.sent.seq[(trace.sent.link == speaker) & (trace.sent.stamp < end - MARGIN_S)]
    net = trace.plan.pose_links
    mine = trace.received.link == np.flatnonzero((net.receiver == listener) & (net.sender == speaker))
    return said, np.intersect1d(said, trace.received.seq[mine])


@pytest.mark.mechanism("modelled channel in real time")
def test_receivers_lose_what_the_virtual_network_loses(tmp_path):
    changes = (*BAD, "duration_s=3", "robots.CF01.hover=0.3", "formation.gain=1.4")
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", "--json", *changes)
    code, out = flight.finish()
    assert code == 0, flight.said()
    robots = json.loads(out)["cases"]["periodic"]["robots"]
    assert [robot["lost"] for robot in robots.values()] == [0, 0, 0], "of the real network nothing is lost"

    real = flight.read("periodic").trace
    # the same in virtual time, longer: robots start sooner there, and their numbers must overlap
    other = flown("triangle", "periodic", *BAD, "formation.gain=1.4", "duration_s=15").trace
    transmitted = np.bincount(real.sent.link, minlength=3)
    assert (transmitted <= 50.0 * 3.0 + 1).all()
    assert (transmitted >= 50.0 * 3.0 - real.missed_deadlines - 3).all(), "except at ticks that they missed"
    net, shares, sent = real.plan.pose_links, [], 0
    pairs = sorted({(int(net.receiver[link]), int(net.sender[link])) for link in real.received.link})
    assert len(pairs) == len(real.dropped)
    for listener, speaker in pairs:
        said, heard = sent_and_heard(real, listener, speaker, 3.0)
        said_there, heard_there = sent_and_heard(other, listener, speaker, 15.0)
        both = np.intersect1d(said, said_there)
        assert len(both) > 50
        np.testing.assert_array_equal(np.intersect1d(heard, both), np.intersect1d(heard_there, both))
        shares.append(1.0 - len(heard) / len(said))
        sent += int(transmitted[speaker])
    assert np.mean(shares) == pytest.approx(0.3, abs=0.06)
    assert (real.received.arrival - real.received.stamp).min() >= 0.05 - 1e-5
    assert real.dropped.sum() == pytest.approx(0.3 * sent, rel=0.15)


def test_centre_communicates_over_the_same_network(tmp_path):
    changes = (*BAD, "duration_s=4", "architecture=centralised")
    flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *changes)
    assert flight.finish()[0] == 0, flight.said()
    case = reopen(flight.folder).metrics["periodic"]
    centre = case.guidance
    assert case.lost == 0, "of the real network nothing is lost"
    sent = sum(robot.messages for robot in case.robots)
    assert centre.poses_lost / sent == pytest.approx(0.3, abs=0.07)
    assert centre.goals_lost / centre.goals == pytest.approx(0.3, abs=0.15)
    goals = flight.read("periodic").trace.goals
    assert goals.delay.min() >= 0.1 - 1e-5, "both ways"


FORMED_S = 100.0  # limit for robots to agree or to form up: a busy machine computes fewer steps in a second


class Averages(Watcher):
    """The numbers of six robots, and whether all are near their average."""

    def __init__(self, endpoint):
        super().__init__(endpoint)
        self.told = self.newest(self.keys.memory("*"), messages.LawMemory)

    def until_agreed(self):
        def agreed():
            return len(self.told) == 6 and all(abs(each.variables["x"][0] - 3.0) < 0.06 for each in self.told.values())

        self.until(agreed, "they agree", FORMED_S)


@pytest.mark.mechanism("words")
def test_robots_agree_on_an_average_in_real_time(tmp_path):
    """With a fifth of the messages lost, in two processes of three robots."""
    groups = [f"robots.KH0{number}.process={'odd' if number % 2 else 'even'}" for number in range(1, 7)]
    flight = Flight(tmp_path / "run", "average", "--case", "event-loss", *groups, "duration_s=120")
    flight.until_flown()
    with Averages(flight.endpoint()) as watcher:
        watcher.until_agreed()
    flight.interrupt()
    file, trace = flight.folder / "event-loss.mcap", flight.read("event-loss").trace
    assert np.abs(trace.memory["x"][0] - 3.0).max() > 1.0
    assert trace.measures["disagreement"].shape == (len(trace.time), 6)
    assert trace.dropped.sum() > 0
    spoken = typed(file, "/KH01/spoken_pose")
    assert [each.name for each in spoken[-1].shared] == ["x", "q", "n"]
    assert len(typed(file, "/KH01/pose")) < len(spoken) / 3  # those before its first step


@pytest.mark.mechanism("words: restart")
def test_a_restarted_robot_joins_without_drawing_the_others(tmp_path):
    """The first words of a restarted robot are a step old, and its number is 1 from the average, which all keep."""
    flight = Flight(tmp_path / "run", "average", "--case", "periodic", 'on_loss="restart"', "duration_s=180")
    flight.until_flown()
    with Averages(flight.endpoint()) as watcher:
        watcher.until_agreed()
        first = watcher.status["KH03"].pid
        flight.children()["KH03"].kill()
        watcher.until(lambda: watcher.status["KH03"].pid != first, "it is restarted", FORMED_S)
        watcher.told.clear()
        watcher.until_agreed()
    flight.interrupt()
    trace = flight.read("periodic").trace
    apart = np.abs(trace.memory["x"][..., 0] - 3.0)
    agreed = np.flatnonzero(apart.max(axis=1) < 0.06)[0]
    assert np.nanmax(np.delete(apart[agreed:], 2, axis=1)) < 1.0


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(["conductor"], marks=pytest.mark.mechanism("chaos")),
        ["router", "clock", "double", "conductor"],
        ["mocap-frozen"],
        ["sleep"],
    ],
)
def test_faults_are_made_and_recovered_from(tmp_path, kinds):
    folder = tmp_path / "chaos"
    of = ("--faults", len(kinds), "--seed", "1", "--kinds", ",".join(kinds), *NEAR_TRIANGLE, "duration_s=40")
    words = options("-m", "tests", "--chaos", "triangle", *of, "--json", "--out", folder)
    done = python(*words, code=None, timeout_s=150.0)
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    outcomes = result["outcomes"]
    assert sorted(each["fault"]["kind"] for each in outcomes) == sorted(kinds), done.stderr
    assert all(each["recovered"] for each in outcomes), done.stderr
    assert not [each for each in outcomes if each["fault"]["kind"] == "double" and each["violations"]]
    assert not any("left behind" in text for each in result["rounds"] for text in each["violations"])
    assert json.loads((folder / "chaos.json").read_text()) == result


def test_three_robots_for_a_few_seconds(tmp_path):
    asked = ("triangle", "--minutes", "0.1", "--json", "--out", str(tmp_path / "soak"))
    done = python("-m", "tests", "--soak", *asked, code=None, timeout_s=120.0)
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    texts = [finding["text"] for finding in said["findings"]]
    assert texts[0].startswith("all 3 robots lived"), texts
    assert any(text.startswith("0 of ") and text.endswith("poses were lost") for text in texts), texts
    rows = list(csv.DictReader((tmp_path / "soak" / "soak.csv").read_text().splitlines()))
    assert {row["process"] for row in rows} == {"KH01", "KH02", "CF01", "router", "recorder", "conductor"}
    assert all(float(row["rss_mb"]) > 5.0 and int(row["threads"]) > 0 for row in rows)
