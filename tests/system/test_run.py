"""Whole runs in real time: undisturbed, with killed processes, a bad network, laws that talk, faults on purpose."""

import csv
import json

import numpy as np
import pytest

from agents.network import messages
from tests.commands import python
from tests.runs import flown
from tests.system.lab import NEAR_TRIANGLE, Flight, Watcher, options, typed

pytestmark = pytest.mark.system

EVENT = ("--case", "event", "--json")


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
    real = flight.read("periodic").trace
    lost = sum(robot["lost"] for robot in json.loads(out)["cases"]["periodic"]["robots"].values())
    assert lost < 0.5 * real.dropped.sum(), "drops of the model are counted apart; a busy machine loses some poses"
    # the same in virtual time, longer: robots start sooner there, and their numbers must overlap
    other = flown("triangle", "periodic", *BAD, "formation.gain=1.4", "duration_s=15").trace
    transmitted = np.bincount(real.sent.link, minlength=3)
    assert (transmitted <= 50.0 * 3.0 + 1).all()
    assert (transmitted >= 50.0 * 3.0 - real.missed_deadlines - 3).all(), "except at ticks that they missed"
    net, shares, sent, missing = real.plan.pose_links, [], 0, 0
    pairs = sorted({(int(net.receiver[link]), int(net.sender[link])) for link in real.received.link})
    assert len(pairs) == len(real.dropped)
    for listener, speaker in pairs:
        said, heard = sent_and_heard(real, listener, speaker, 3.0)
        said_there, heard_there = sent_and_heard(other, listener, speaker, 15.0)
        both = np.intersect1d(said, said_there)
        assert len(both) > 50
        assert np.isin(np.intersect1d(heard, both), heard_there).all()
        missing += len(np.setdiff1d(np.intersect1d(heard_there, both), heard))
        shares.append(1.0 - len(heard) / len(said))
        sent += int(transmitted[speaker])
    assert missing <= lost
    assert np.mean(shares) == pytest.approx(0.3, abs=0.06 + lost / sent)
    assert (real.received.arrival - real.received.stamp).min() >= 0.05 - 1e-5
    assert real.dropped.sum() == pytest.approx(0.3 * sent, rel=0.15 + lost / sent)


AGREED = 0.15  # distance from the average, of signals that are up to 4 away from it
FORMED_S = 100.0  # limit for robots to agree or to form up: a busy machine computes fewer steps in a second


class Averages(Watcher):
    """The numbers of six robots, and whether all are near their average."""

    def __init__(self, endpoint):
        super().__init__(endpoint)
        self.told = self.newest(self.keys.memory("*"), messages.LawMemory)

    def until_agreed(self):
        def agreed():
            return len(self.told) == 6 and all(
                abs(each.variables["x"][0] - 3.0) < AGREED for each in self.told.values()
            )

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
    poses = typed(file, "/KH01/pose")
    spoken = [pose for pose in poses if hasattr(pose, "shared")]
    assert [each.name for each in spoken[-1].shared] == ["n", "q", "x"]
    assert len(poses) - len(spoken) < len(spoken) / 3  # those before its first step


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
    agreed = np.flatnonzero(apart.max(axis=1) < AGREED)[0]
    assert np.nanmax(np.delete(apart[agreed:], 2, axis=1)) < 1.0


@pytest.mark.mechanism("chaos")
def test_script_is_done_to_real_processes(tmp_path):
    folder, of = tmp_path / "chaos", ("--faults", 1, "--seed", 1, "--kinds", "pause", *NEAR_TRIANGLE, "duration_s=5")
    words = options("-m", "tests", "--chaos", "triangle", *of, "--json", "--out", folder)
    done = python(*words, code=None, timeout_s=150.0)
    assert done.stdout, done.stderr
    (flown,) = json.loads(done.stdout)
    assert flown["script"][0].split(", ")[1] == "'pause'"
    assert flown["violations"] == [], done.stderr
    assert json.loads((folder / "chaos.json").read_text()) == [flown]


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
