"""Every robot behind its real bridge and a protocol twin, in one command."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from experiments.metrics.measure import measure
from experiments.real_time.hosts.launcher import LAND_S
from experiments.recording import playback
from tests.requests import request
from tests.system.lab import NEAR, Flight, assert_formed, gone, transmits_at_50_hz, until
from tests.twins.loopback import Served
from twins.devices import khepera4

pytestmark = pytest.mark.system


@pytest.mark.timeout(180)
def test_the_reference_experiment_flies_behind_real_bridges(tmp_path):
    folder = tmp_path / "run"
    words = ("--bodies", "protocol", "--case", "event", "--json", "duration_s=10", "timeline=[]")
    flight = Flight(folder, "robotic-park", *words, *NEAR)
    flight.until_flown()
    children = flight.children()
    bodies = {name: line for name in children for line in [children[name].cmdline()]}
    assert bodies["CF01"] == bodies["CF02"] == bodies["CF03"], "one radio, one process"
    addressed = json.loads((folder / "cases" / "event" / "addressed.json").read_text())["robots"]
    assert addressed["CF01"]["body"].startswith("radio://0/80/2M/E7E7E7E701?software=127.0.0.1:")
    assert addressed["KH01"]["body"].startswith("khepera4://127.0.0.1:")
    assert addressed["TB01"]["body"].startswith(("ros2dds://", "rmw://"))
    everyone = list(children.values())
    code, out = flight.finish(90.0)
    assert code == 0, flight.said()
    until(lambda: gone(everyone), "nothing is left", LAND_S)
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert all(robot["lost"] == 0 for robot in robots.values())
    followers = {name: robot for name, robot in robots.items() if name != "TB01"}
    assert all(robot["acquired_s"] is not None for robot in followers.values()), followers
    trace = playback.read(folder / "event.mcap").trace
    assert np.isfinite(trace.true_position).all(axis=(1, 2)).mean() > 0.98, "the truth is known"
    heights = trace.true_position[trace.time > 5.0][:, 4:, 2]
    assert np.abs(heights - 0.8).max() < 0.1
    assert_formed(trace, 0.05, since_s=trace.time[-1] - 1.0)


def heard_of(folder):
    """What the neighbours of a run hear: keys, structs, how often; and nothing of what the robots are."""
    with (folder / "periodic.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        topics = {c.topic: summary.schemas[c.schema_id].data for c in summary.channels.values()}
        poses = [message for *_, message in reader.iter_decoded_messages([t for t in topics if t.endswith("/pose")])]
    trace = playback.read(folder / "periodic.mcap").trace
    transmits_at_50_hz(trace)
    return {"topics": topics, "fields": {tuple(pose.__slots__) for pose in poses}}


def test_swap_is_one_word_without_difference_to_neighbours(tmp_path):
    twins, protocol = tmp_path / "twins", tmp_path / "protocol"
    short = ("--case", "periodic", "duration_s=4")
    assert Flight(twins, "triangle", *short).finish()[0] == 0
    assert Flight(protocol, "triangle", *short, "robots.CF01.body=crazyflie-twin").finish()[0] == 0
    addressed, plain = (
        json.loads((protocol / "cases" / "periodic" / f"{name}.json").read_text())["robots"]
        for name in ("addressed", "experiment")
    )
    assert addressed["CF01"].pop("body").startswith("udp://127.0.0.1:")
    assert plain["CF01"].pop("body") == "crazyflie-twin"
    assert addressed == plain, "only the address differs"
    assert heard_of(twins) == heard_of(protocol)


def test_robot_that_does_not_move_fails_the_run(tmp_path):
    """A Khepera whose server ignores `d`, and answers as one that obeys it."""
    twin = Served(khepera4.KheperaDevice, request("khepera4", ["khepera4-twin"], device={"server": "2023-01-15"}))
    file = tmp_path / "pair.toml"
    with twin:
        body = f"{twin.addresses[0]}?server=fork"
        file.write_text(
            f"""
title = "A pair of which one does not move"
duration_s = 6.0
robots.KH01 = {{ kind = "khepera4", start = [0.8, 0.0, 0.0], body = "{body}" }}
robots.KH02 = {{ kind = "khepera4", start = [-0.8, 0.0, 0.0] }}
formation.links = {{ "KH01 - KH02" = 0.4 }}
trigger = {{ kind = "periodic", period_s = 0.05 }}
"""
        )
        flight = Flight(tmp_path / "run", file)
        code, out = flight.finish()
        assert abs(twin.truth()[0][0, 0]) < 0.001
    assert code == 1, out + flight.said()
    assert "hazard KH01: warn: it does not obey commands to move: 0." in flight.said()
    assert "zenpark: Failed in default: KH01 at " in flight.said()
    assert "error [m] KH01 0." in flight.said()


def test_twins_shadow_a_crazyflie_and_a_khepera(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(
        folder, "triangle", "--case", "periodic", "--json", "duration_s=4",
        "robots.CF01.body=crazyflie-twin", "robots.CF01.shadow={restart_s=1.5}",
        "robots.KH01.body=khepera4-twin", "robots.KH01.shadow={}",
    )  # fmt: skip
    code, out = flight.finish()
    assert code == 0, flight.said()
    assert json.loads(out)["cases"]["periodic"]["collisions"] == 0
    trace = playback.read(folder / "periodic.mcap").trace
    known = np.isfinite(trace.shadow_position).all(axis=2).mean(axis=0)
    assert known.tolist() == [pytest.approx(1.0, abs=0.05), 0.0, pytest.approx(1.0, abs=0.05)]
    khepera, none, crazyflie = (robot.shadow for robot in measure(trace).robots)
    assert none is None
    assert (khepera.horizon_s, crazyflie.horizon_s) == (5.0, 1.5)
    moved = np.ptp(trace.position[:, [0, 2], :2], axis=0)
    assert (moved.max(axis=1) > 0.1).all()
    assert khepera.rmse < 0.03  # measured: 6 mm
    assert crazyflie.rmse < 0.05
    assert -0.05 < crazyflie.bias[2] < -0.01  # the law of the shadow does not overshoot its take-off
    for shadow, far in ((khepera, moved[0]), (crazyflie, moved[1])):
        axis = int(far.argmax())
        correlation = shadow.correlation[axis]
        assert correlation > 0.98
