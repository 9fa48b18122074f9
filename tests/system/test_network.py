"""A bad network in real time: the listeners lose and delay what the same file loses and delays in virtual time."""

import json

import numpy as np
import pytest

from experiments.recording import playback
from experiments.run import reopen
from tests.runs import flown
from tests.system.lab import Flight, transmits_at_50_hz

pytestmark = pytest.mark.system

BAD = ("channel.loss=0.3", "channel.delay_s=0.05")
MARGIN_S = 0.2  # what was said so shortly before the end may still be under way


def sent_and_heard(trace, listener, speaker, end):
    """Running numbers of the run that a robot said, and those of them that another one heard."""
    said = trace.sent.seq[(trace.sent.link == speaker) & (trace.sent.stamp < end - MARGIN_S)]
    net = trace.plan.pose_links
    mine = trace.received.link == np.flatnonzero((net.receiver == listener) & (net.sender == speaker))
    return said, np.intersect1d(said, trace.received.seq[mine])


def virtual(duration_s):
    """The same in virtual time, longer: robots start sooner there, and their numbers must overlap."""
    return flown("triangle", "periodic", *BAD, "formation.gain=1.4", f"duration_s={duration_s}").trace


@pytest.mark.mechanism("modelled channel in real time")
def test_receivers_lose_what_the_virtual_network_loses(tmp_path):
    folder = tmp_path / "run"
    changes = (*BAD, "duration_s=3", "robots.CF01.hover=0.3", "formation.gain=1.4")
    flight = Flight(folder, "triangle", "--case", "periodic", "--json", *changes)
    code, out = flight.finish()
    assert code == 0, flight.said
    robots = json.loads(out)["cases"]["periodic"]["robots"]
    assert [robot["lost"] for robot in robots.values()] == [0, 0, 0], "of the real network nothing is lost"

    real, other = playback.read(folder / "periodic.mcap").trace, virtual(15.0)
    transmits_at_50_hz(real)
    shares, sent = [], 0
    net = real.plan.pose_links
    pairs = sorted({(int(net.receiver[link]), int(net.sender[link])) for link in real.received.link})
    assert len(pairs) == len(real.dropped if real.dropped is not None else ())
    for listener, speaker in pairs:
        said, heard = sent_and_heard(real, listener, speaker, 3.0)
        said_there, heard_there = sent_and_heard(other, listener, speaker, 15.0)
        both = np.intersect1d(said, said_there)
        assert len(both) > 50
        np.testing.assert_array_equal(np.intersect1d(heard, both), np.intersect1d(heard_there, both))
        shares.append(1.0 - len(heard) / len(said))
        sent += int((real.sent.link == speaker).sum())
    assert np.mean(shares) == pytest.approx(0.3, abs=0.06)

    delay = real.received.arrival - real.received.stamp
    assert delay.min() >= 0.05 - 1e-5
    assert real.dropped.sum() == pytest.approx(0.3 * sent, rel=0.15)


def test_centre_communicates_over_the_same_network(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "periodic", *BAD, "duration_s=4", "architecture=centralised")
    code, _ = flight.finish()
    assert code == 0, flight.said
    case = reopen(folder).metrics["periodic"]
    centre = case.guidance
    assert case.lost == 0, "of the real network nothing is lost"
    sent = sum(robot.messages for robot in case.robots)
    assert centre.poses_lost / sent == pytest.approx(0.3, abs=0.07)
    assert centre.goals_lost / centre.goals == pytest.approx(0.3, abs=0.15)
    goals = playback.read(folder / "periodic.mcap").trace.goals
    assert goals.delay.min() >= 0.1 - 1e-5, "both ways"
