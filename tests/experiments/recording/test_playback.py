"""A recording is read back as what was written: gaps, begin, end, clocks set right; odd messages change nothing."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace

from agents.network.messages import (
    CentreState,
    Contact,
    Event,
    GoalReceipt,
    HostClock,
    Pose,
    PoseReceipt,
    State,
    encode,
)
from experiments.definition.experiment import Formation, Rates, RobotTable
from experiments.metrics.measure import measure
from experiments.recording.clocks import ClockSample, Correction, host_offset
from experiments.recording.losses import count_in_run
from experiments.recording.playback import NotStarted, read, read_whole
from experiments.recording.reader import RecordingError, recover
from experiments.recording.ros2 import payload
from experiments.run import reopen
from tests.experiments import recordings as rec

GRID = np.arange(11) / 10


def test_a_run_is_read_back(path):
    rec.write(path, *rec.whole_run())
    playback = read(path)
    trace = playback.trace
    assert (playback.complete, playback.messages, playback.started) == (True, 1 + 4 + 22 * 3 + 11, rec.START)
    assert (trace.case, trace.seed, trace.clock, trace.robots) == ("only", 4, "real", ("TB01", "CF01"))
    assert trace.plan.experiment == rec.PAIR
    assert (trace.attitude, trace.shadow_position, trace.shadow_yaw) == (None, None, None)
    sent, received, net = trace.sent, trace.received, trace.plan.pose_links
    for found, wanted in (
        (trace.time, GRID),
        (trace.position[..., 0], np.column_stack([GRID, -GRID])),
        (trace.true_position[:, 0, 2], np.full(11, 0.01)),
        (trace.true_position[:, 1], trace.position[:, 1]),
        (trace.goal[:, 0], np.column_stack([GRID + 1, GRID * 0 + 2, GRID * 0 + 3])),
        (trace.setpoint[5, 1], [-0.5, 0.0, 0.5, 0.25]),
        (sent.stamp, GRID[:-1]),
        (sent.position[:, :2], np.column_stack([GRID[:-1], GRID[:-1] * 0 + 0.5])),
        (sent.velocity, np.tile([0.1, 0.2, 0.3], (10, 1))),
        (sent.yaw, [0.4] * 10),
        (received.arrival, GRID[1:] - 0.04),
        (received.stamp, GRID[1:] - 0.05),
        (received.position[:, 0], GRID[1:] - 0.05),
        (received.velocity, np.tile([1.0, 0.0, 0.0], (10, 1))),
    ):
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-6)
    assert {(net.receiver[link], net.sender[link]) for link in received.link} == {(1, 0)}
    sizes = [len(encode(each)) for each in rec.whole_run() if isinstance(each, Pose)]
    assert (sent.bytes.tolist(), sent.seq.tolist(), received.seq.tolist()) == (sizes[:10], *[[*range(1, 11)]] * 2)
    counts = [each.tolist() for each in (trace.lost, trace.ticks, trace.missed_deadlines, trace.decisions)]
    assert (counts, trace.events) == ([[1, 0], [100, 99], [3, 0], [10, 9]], (Event(0.0, "start", "conductor", "go"),))


def test_what_the_world_said_is_read_back(path):
    touches = [rec.touched(0.7), rec.touched(-0.1), rec.touched(0.2, second="wall"), rec.touched(1.2)]
    rec.broken(path, *rec.whole_run(), *map(rec.world_state, (-0.5, 0.5, 1.5)), *touches)
    trace = read(path).trace
    second = [("wall", 0.2), ("CF01", 0.7)]
    wanted = [Contact(pytest.approx(at, abs=1e-6), "TB01", name, 0.25, 0.001) for name, at in second]
    assert [*trace.contacts] == wanted
    assert [*trace.world] == [replace(rec.world_state(0.5), stamp=pytest.approx(0.5, abs=1e-6))]


@pytest.mark.parametrize(("engine", "contacts"), [(None, None), ("point-mass", None), ("other", None), ("pymunk", ())])
def test_no_contacts_differ_from_no_contact_detection(path, engine, contacts):
    said = [] if engine is None else [rec.world_state(0.5, engine)]
    assert rec.trace_of(path, *rec.whole_run(), *said).contacts == contacts


def test_attitude_interpolates_the_short_way_on_recorded_side(path):
    half, sign = 0.1 * np.arange(12), np.array([-1.0 if k in {3, 4, 5} else 1.0 for k in range(12)])
    turned = (sign * [np.cos(half), 0.0 * half, np.sin(half), 0.0 * half]).T.tolist()
    said = [
        rec.state(at=at, x=at, attitude=tuple(turned[k]), shadow_position=(at, 0.1, 0.0), shadow_yaw=3.0 + at)
        for k, at in enumerate((np.arange(12) / 10 - 0.05).tolist())
    ]
    trace, half = rec.trace_of(path, rec.begun(), *said), half[:11] + 0.05
    wanted = (sign[:11] * [np.cos(half), 0.0 * half, np.sin(half), 0.0 * half]).T
    np.testing.assert_allclose(trace.attitude[:, 0], wanted, atol=1e-6)
    np.testing.assert_allclose(trace.shadow_position[:, 0] - trace.position[:, 0], np.tile([0.0, 0.1, 0.0], (11, 1)))
    np.testing.assert_allclose(trace.shadow_yaw[:, 0], 3.0 + GRID, atol=1e-6)
    assert all(np.isnan(array[:, 1]).all() for array in (trace.attitude, trace.shadow_position))


@pytest.mark.parametrize("yaw", [[math.remainder(0.9 * k, math.tau) for k in range(11)], [None] * 5 + [0.3] * 6])
def test_yaw_keeps_the_branch_it_was_recorded_on(path, yaw):
    trace = rec.trace_of(path, rec.begun(), *[rec.state(at=k / 10, yaw=value) for k, value in enumerate(yaw)])
    found, known = trace.yaw[:, 0], yaw.count(None)
    np.testing.assert_allclose(found[known:], yaw[known:], atol=1e-5)
    assert np.isnan(found[: max(known - 2, 0)]).all()


def test_samples_between_the_grid_are_interpolated(path):
    between = [(k / 10 + 0.05, math.remainder(k, math.tau)) for k in range(-1, 11)]
    trace = rec.trace_of(path, rec.begun(), *[rec.state(at=at, x=at, yaw=yaw) for at, yaw in between])
    np.testing.assert_allclose(trace.position[:, 0, 0], GRID, atol=1e-6)
    np.testing.assert_allclose(trace.goal[:, 0, 0], GRID + 0.95, atol=1e-6)  # the last one before
    turned = np.arctan2(np.sin(trace.yaw[:, 0]), np.cos(trace.yaw[:, 0]))
    np.testing.assert_allclose(turned, [math.remainder(k - 0.5, math.tau) for k in range(11)], atol=1e-4)


def test_silence_is_nan_and_never_extrapolated(path, tmp_path):
    unknown = {"goal": None, "setpoint": None, "yaw": math.nan, "position": (math.nan, 0.0, 0.0)}
    said = [rec.state(at=k / 10, x=k / 10, **(unknown if k == 3 else {})) for k in range(6)]
    trace = rec.trace_of(path, rec.begun(), rec.landed(), *said, experiment=rec.PACKED)
    np.testing.assert_allclose(trace.position[:8, 0, 0], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.5], atol=1e-6)
    for array in (trace.position, trace.yaw, trace.true_position, trace.goal, trace.setpoint):
        assert np.isnan(array[8:, 0]).all()
        assert np.isnan(array[:, 1]).all()  # never reported
    assert np.isfinite(np.delete(trace.goal[:8, 0], 3, axis=0)).all()
    assert np.isnan(trace.goal[3, 0]).all()
    states, two = [rec.state(at=at, x=at) for at in (0.0, 0.1, 0.6, 0.7, 2.0, 2.1)], rec.pair_with(duration_s=2.0)
    x = rec.trace_of(tmp_path / "hole.mcap", rec.begun(), *states, experiment=two).position[:, 0, 0]
    np.testing.assert_allclose(x[:8], np.arange(8) / 10, atol=1e-6)
    assert np.flatnonzero(np.isnan(x)).tolist() == list(range(10, 18)), "a long hole is not drawn over"


def poses(*numbered):
    """Poses of TB01, by number and time [s]."""
    return [rec.pose(seq=seq, at=at) for seq, at in numbered]


def lost_of(*counted, **more):
    """Statuses of CF01 with what it lost of TB01, by time [s] and number."""
    return [rec.status("CF01", at=at, lost={"TB01": lost}, **more) for at, lost in counted]


@pytest.mark.parametrize(
    ("messages", "lost"),
    [
        (poses((1, 0.1), (2, 0.2), (5, 0.5), (6, 0.6)), 2),  # a gap of two
        (poses((8, 0.1), (9, 0.2), (3, 0.3), (4, 0.4)), 2),  # began anew, the first two lost
        # a forged number: no more than 50 poses a second can have been said
        (poses((8, 0.1), (99_999_999, 0.12), (9, 0.14), (10, 0.16)), 2),
        ([*poses((8, 0.1)), rec.status(at=0.9, sent=99_999_999)], 40),
        (poses((4, 0.1), (4, 0.1), (5, 0.2)), 0),  # the same twice: said again to a late one
        (poses((1, -2.0), (9, 0.1), (10, 0.2)), 0),  # a gap that began before the run
        ([*poses((5, 0.9)), rec.status(sent=8)], 3),  # the last three never came
        ([*poses((5, 0.9), (6, 1.2)), rec.status(sent=5)], 0),
        ([*poses((9, 0.5)), rec.status(sent=2, pid=8)], 0),  # a younger process counts from zero
        ([rec.status(at=-0.5, sent=4), rec.status(sent=6)], 2),  # none of them recorded
        ([*poses((3, -0.2)), rec.status(at=-1.0, sent=2), rec.status(sent=4)], 1),
        (lost_of((-0.5, 4), (1.0, 6)), 2),  # less what was before
        (lost_of((0.2, 1), (0.6, 1), (1.0, 3)), 3),  # counters go up
        ([*lost_of((-0.5, 4), (0.2, 5)), *lost_of((0.9, 2), pid=8)], 3),  # one, then two of a later process
        (lost_of((30.0, 4)), 0),  # long after the run
    ],
)
def test_lost(path, messages, lost):
    assert rec.trace_of(path, rec.begun(), rec.state(), *messages, rec.landed()).lost.tolist() == [lost, 0]


def test_counters_of_statuses_count_in_the_run(path, tmp_path):
    said = [rec.status(at=k - 0.5, interventions=5 * k, avoided=2 * k) for k in range(4)]
    said += [*[rec.pose(seq=k + 5, at=k / 2) for k in range(-2, 5)], rec.pose("XX99", at=0.5)]
    trace = rec.trace_of(path, rec.begun(), *said, rec.status(at=0.9, foreign={"TB01": 2**60}))
    assert (trace.interventions.tolist(), trace.avoided.tolist()) == ([8, 0], [3, 0])
    assert not trace.foreign.any(), "no robot can have counted that"
    assert trace.sent.stamp.tolist() == [0.0, 0.5]  # the pose at the end, 1.0, belongs to the landing
    assert trace.sent.seq.tolist() == [5, 6]

    said = [rec.status("CF01", at=at, dropped={"TB01": count}) for at, count in ((-0.5, 0), (0.4, 3), (1.0, 7))]
    linked = rec.pair_with(formation=Formation(links={"TB01 - CF01": 0.5}))
    path = tmp_path / "dropped.mcap"
    trace = rec.trace_of(path, rec.begun(), rec.state(), *said, rec.landed(), experiment=linked)
    assert (trace.dropped.tolist(), trace.lost.tolist()) == ([0, 7], [0, 0])


def test_foreign_poses_count_once_for_all_receivers(path):
    robots = {name: RobotTable("tello", [float(k), 0.0]) for k, name in enumerate("ABC")}
    counts = (("B", -0.5, 2), ("C", -0.5, 0), ("B", 0.4, 5), ("C", 0.4, 1), ("B", 1.0, 9), ("C", 1.0, 3))
    said = [rec.status(name, at=at, foreign={"A": count}) for name, at, count in counts]
    three = rec.pair_with(robots=robots, formation=Formation(links={"A > B": 0.5, "A > C": 0.5}))
    states = [rec.state(name) for name in robots]
    assert rec.trace_of(path, rec.begun(), *states, *said, rec.landed(), experiment=three).foreign.tolist() == [7, 0, 0]


def test_impossible_counts_of_the_centre_are_left_out(path):
    reports = [CentreState(rec.START + 0.5, ["CF01"], received={"TB01": count}) for count in (4, 2**60, -3)]
    trace = rec.trace_of(path, *rec.whole_run(), *reports, experiment=rec.pair_with(architecture="centralised"))
    assert trace.goals.received.tolist() == [4, 0]


def test_what_a_drifting_clock_stamped_is_set_right(path):
    """50 ppm over an hour are 0.18 s: what CF01 says at 3600 s it stamps 0.18 s later."""
    clocks = [clock_of("lab2", rec.START + at, lie) for at, lie in ((0.0, 0.2), (3600.0, 0.38))]
    heard = [PoseReceipt("CF01", 9, rec.START + 1800.09, rec.START + 1800.01, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))]
    messages = [rec.begun(), *clocks]
    for k in range(0, 3601, 10):
        messages += [rec.state("TB01", k + 1, k, 0.001 * k), rec.state("CF01", k + 1, k * (1 + 50e-6), 0.001 * k)]
    messages += [rec.state("TB01", 9000, 3600.5, 3.6, received=heard), rec.pose("CF01", 1, 1800.09), rec.landed(3600.0)]
    hour = rec.pair_with(duration_s=3600.0, rates=Rates(state_hz=1.0))
    trace = rec.trace_of(path, *messages, experiment=hour)
    np.testing.assert_allclose(trace.position[[600, 1800, 3600], :, 0], [[x, x] for x in (0.6, 1.8, 3.6)], atol=1e-6)
    said = trace.sent.stamp[0], trace.received.stamp[0], trace.received.arrival[0]  # the last on the listener's clock
    assert said == pytest.approx((1800.0, 1800.0, 1800.01), abs=1e-4)


def test_the_start_is_the_conductors_else_the_robots(path, tmp_path):
    states, begun = [rec.state(at=0.0), rec.state(at=0.5, x=1.0)], rec.status(started=rec.START + 0.5)
    trace = rec.trace_of(path, *states, begun, rec.status("CF01", started=0.0), rec.landed(1.5))
    assert np.isfinite(trace.position[:, 0, 0]).tolist() == [True] * 3 + [False] * 8
    trace = rec.trace_of(tmp_path / "both.mcap", *states, rec.begun(0.2), begun, rec.landed(1.2))
    assert (trace.position[3, 0, 0], trace.events[0].stamp) == (pytest.approx(1.0), 0.0)


def test_trace_of_an_interrupted_run_ends_there(path):
    sends = [rec.pose(seq=k + 1, at=k / 10, x=k / 10) for k in range(11)]
    said = [rec.status(at=0.6, sent=7, ticks=60, decisions=6), rec.status(at=2.5, sent=11, ticks=250, decisions=25)]
    trace = rec.trace_of(path, rec.begun(), *rec.seconds(11), *sends, *said, rec.landed(0.75, "landing (interrupted)"))
    assert (trace.time[-1], trace.events[-1].stamp) == pytest.approx((0.7, 0.75))
    assert (trace.position.shape, np.isfinite(trace.position).all()) == ((8, 2, 3), True)
    assert (trace.sent.seq.tolist(), trace.lost.tolist()) == (list(range(1, 9)), [0, 0])


def follow(begin, end, phase="running"):
    """States of TB01 alone."""
    return [rec.state("TB01", k, k / 10, phase=phase) for k in range(begin, end)]


@pytest.mark.parametrize(
    ("duration_s", "messages", "end", "silent"),
    [
        (1.0, [*rec.seconds(11), rec.landed(1.3, "landing (interrupted)")], 1.0, False),
        (1.0, [*rec.seconds(11), rec.landed(0.98)], 1.0, False),
        (5.0, [*rec.seconds(31), rec.landed(3.0)], 3.0, False),
        (20.0, [*rec.seconds(31), *follow(31, 36), *follow(41, 60, "landing")], 3.0, False),
        (20.0, [*rec.seconds(31), *follow(31, 100)], 9.9, True),
    ],
    ids=["stopped after the end", "landed slightly early", "all landed", "no conductor", "one long silent"],
)
def test_end_of_a_run(path, duration_s, messages, end, silent):
    trace = rec.trace_of(path, rec.begun(), *messages, experiment=rec.pair_with(duration_s=duration_s))
    assert trace.time[-1] == pytest.approx(end)
    assert np.isfinite(trace.position[-1]).all(axis=1).tolist() == [True, not silent]


@pytest.mark.parametrize(
    ("began", "says"),
    [
        ([rec.begun(), rec.landed(-0.5, "landing (interrupted)")], "ended before the common start"),
        ([rec.begun(), rec.landed(0.05, "landing (interrupted)")], "ended before the common start"),
        ([rec.status(started=0.0)], "no robot had started"),
    ],
)
def test_a_run_that_never_started(path, began, says):
    with pytest.raises(NotStarted, match=says):
        rec.trace_of(path, rec.state(), *began)


@pytest.mark.parametrize("off_s", [-1e-3, -1e-6, -2e-8, 0.0, 2e-7, 1e-6])
def test_run_of_one_period_is_measured_or_none(path, off_s):
    """Whose recorder broke off there: UTC stamps have a grain of 0.24 microseconds."""
    try:
        trace = rec.trace_of(path, rec.begun(), rec.state(at=0.0), rec.state(seq=2, at=0.1 + off_s, phase="running"))
    except NotStarted:
        assert off_s <= 0.0
    else:
        assert measure(trace).duration_s == pytest.approx(0.1)


def test_impossible_messages_are_left_out(path):
    rec.write(
        path, rec.begun(), replace(rec.state(seq=2**63), stamp=1e300), rec.pose(seq=2**70), rec.status(sent=2**64)
    )
    playback = read(path)
    trace = playback.trace
    assert (playback.messages, trace.position.shape, np.isnan(trace.position).all()) == (4, (11, 2, 3), True)
    assert (len(trace.sent.stamp), len(trace.received.arrival), trace.lost.tolist()) == (0, 0, [0, 0])


@pytest.mark.parametrize("stamp", [math.nan, math.inf, -1.0, 1e19])
def test_broken_clock_does_not_stretch_the_timeline(path, stamp):
    rec.write(path, rec.begun(), rec.landed(), replace(rec.state(), stamp=stamp), experiment=rec.PACKED)
    with path.open("rb") as file:
        found = make_reader(file).get_summary().statistics
    wanted = [round((rec.START + at) * 1e9) for at in (0.0, 1.0)]
    assert [found.message_start_time, found.message_end_time] == wanted
    assert np.isnan(read(path).trace.position).all()


def foreign(path, *channels, metadata=None, attachment=None):
    """Write a file of another program, with one message on each channel (topic, schema name, schema text, data)."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, name, text, data in channels:
            schema = writer.register_schema(name, "ros2msg", text) if name else 0
            writer.add_message(writer.register_channel(topic, "cdr", schema), 1, data, 1)
        if metadata is not None:
            writer.add_metadata("zenpark", metadata)
        if attachment is not None:
            writer.add_attachment(0, 0, "experiment.json", "application/json", attachment)
        writer.finish()


ABOUT, ATTACHED = {"case": "only", "seed": "4", "clock": "real"}, msgspec.json.encode(rec.PAIR)


def test_channels_of_others_are_passed_over(path, tmp_path):
    channels = [("/image", "sensor_msgs/msg/Image", b"uint8 data", b"junk"), ("/raw", "", b"", b"more")]
    foreign(path, *channels, metadata=ABOUT | {"started": repr(rec.START)}, attachment=ATTACHED)
    playback, target = read(path), tmp_path / "target.mcap"
    assert (playback.messages, np.isnan(playback.trace.position).all()) == (2, True)
    path.write_bytes(path.read_bytes()[:-1])
    assert recover(path, target).messages == 2
    with target.open("rb") as file:
        kept = [
            (schema and schema.name, channel.topic, m.data) for schema, channel, m in make_reader(file).iter_messages()
        ]
    assert kept == [("sensor_msgs/msg/Image", "/image", b"junk"), (None, "/raw", b"more")]


@pytest.mark.parametrize(
    ("metadata", "attachment"),
    [
        (None, None),
        (ABOUT, b'{"title": "pair", "robots": {}, "duration_s": 1.0}'),
        (ABOUT | {"seed": "four"}, ATTACHED),
        ({"case": "only"}, ATTACHED),
    ],
)
def test_a_file_without_an_experiment(path, metadata, attachment):
    foreign(path, metadata=metadata, attachment=attachment)
    with pytest.raises(RecordingError, match="holds no experiment"):
        read(path)


@pytest.mark.parametrize("read", [read, read_whole])
def test_a_file_of_another_version(path, read):
    definition, data = payload.schema(State, "json").encode(), payload.wrap(b'{"robot": "TB01", "gait": 1}', "json")
    for text, content, says in (
        (b"string robot\n", b"\0\1\0\0", "/TB01/state was recorded by a version of zenpark with another form of"),
        (definition, data, "message 1 is damaged, or of another version of zenpark: .*`gait`"),
        (definition, data[:-1], "message 1 is damaged, .*cut short"),
    ):
        foreign(path, ("/TB01/state", "zenpark_msgs/msg/State", text, content))
        with pytest.raises(RecordingError, match=says):
            read(path)


SMALL = st.floats(0.0, 0.5)


@given(st.floats(-10.0, 10.0), st.lists(st.tuples(SMALL, SMALL), min_size=1, max_size=20))
def test_offset_is_within_uncertainty_despite_unequal_ways(true, ways):
    samples = [
        ClockSample(100.0 + k, 100.0 + k + there + true, 100.0 + k + there + back)
        for k, (there, back) in enumerate(ways)
    ]
    found, uncertainty = host_offset(samples)
    assert abs(found - true) <= uncertainty + 1e-9
    assert uncertainty == pytest.approx(min(there + back for there, back in ways) / 2, abs=1e-9)


def clock_of(host, stamp, lies, robots=("CF01",)):
    return HostClock(host, stamp, lies, 1e-4, list(robots))


def test_drift_is_removed_after_the_initial_offset():
    begin, drift = 1.7e9, 50e-6
    said = [clock_of("lab2", begin, 0.2), clock_of("lab1", begin, 0.0, ["KH01"]), clock_of("lab2", begin + 600.0, 0.23)]
    right = Correction(said)
    true = begin + np.array([0.0, 10.0, 300.0, 600.0])
    stamped = true + drift * (true - begin)  # its offset of 0.2 s was taken off when it stamped
    assert [right("CF01", float(stamp)) for stamp in stamped] == pytest.approx(list(true), abs=1e-5)
    once_and_here = [right(robot, begin + 5.0) for robot in ("KH01", "TB01")]
    assert once_and_here == [begin + 5.0] * 2
    lab2, lab1 = right.offsets()
    assert (lab2.host, lab2.robots, lab2.over, lab2.drift) == ("lab2", ("CF01",), 600.0, pytest.approx(drift))
    assert lab1.drift is None
    acted = stamped[2] + 0.1 * (1 + drift)
    followed, rest = [GoalReceipt(7, begin + 300.05, stamped[2], acted)], (0.0, 0.0, 0.0)
    state = State("CF01", 1, acted, "running", rest, rest, 0.0, None, None, 0.0, goal_receipts=followed)
    goal = right.state(state).goal_receipts[0]
    assert goal.stamp == begin + 300.05, "the centre runs where the conductor does"
    assert (goal.pose, goal.acted) == pytest.approx((begin + 300.0, begin + 300.1), rel=0, abs=1e-5)


def life(pid, *counts):
    """Statuses of a process: at each time [s] ticks, and a tenth of that in decisions."""
    return [rec.status(at=at, pid=pid, ticks=ticks, decisions=ticks // 10) for at, ticks in counts]


EVERY_SECOND = [(float(k), 100 * k) for k in range(1, 21)]
BETWEEN = [(k + 0.5, 10 * k) for k in range(1, 20)]


@pytest.mark.parametrize(
    ("said", "ticks"),
    [
        ([*life(7, (1.0, 100), (9.0, 900)), *life(8, (12.0, 50), (20.0, 850))], 900 + 850),
        ([*life(1, (1.0, 100), (9.0, 900)), *life(1, (12.0, 50), (20.0, 850))], 900 + 850),  # number given again
        (life(7, (19.5, 1950), (20.5, 2050)), 2000),  # beyond the end
        (life(7, (19.5, 1950)), 1950),
        (life(7, (-0.5, 4000), (0.5, 50), (20.5, 2050)), 2000),  # before the start
        ([*life(7, *EVERY_SECOND), *life(8, *BETWEEN)], 2000 + 190),  # in turn
        (life(7, (8.0, 800), (9.0, 900), (8.5, 1000), (9.5, 1100), (20.0, 2150)), 2150),  # clock set back
    ],
)
def test_counters_of_all_lives_in_the_run(said, ticks):
    ordered = sorted(said, key=lambda each: each.stamp)
    assert count_in_run(ordered, "ticks", rec.START, rec.START + 20.0) == ticks


@pytest.mark.parametrize("seq", [2**63 - 1, 2**53, 0, -5])
def test_forged_running_numbers_count_nowhere(path, seq):
    receipt = PoseReceipt("TB01", seq, rec.START + 0.5, rec.START + 0.51, (9.0, 9.0, 0.0), (0.0, 0.0, 0.0))
    forged = [rec.pose("TB01", seq, 0.5501), rec.state("CF01", 99, 0.555, -0.555, received=[receipt])]
    trace = rec.trace_of(path, *rec.whole_run(), *forged)
    assert trace.sent.seq.tolist() == list(range(1, 11))
    assert measure(trace).robots[0].messages == 10
    assert 9.0 not in trace.received.position


def test_forged_counters_count_nowhere(path, tmp_path):
    forged = rec.status("CF01", at=0.9, ticks=2**60, missed=2**61, lost={"TB01": 2**62}, pid=66)
    whole = rec.trace_of(path, *rec.whole_run(), forged)
    assert (whole.ticks.tolist(), whole.missed_deadlines.tolist(), whole.lost.tolist()) == ([100, 99], [3, 0], [1, 0])
    most = rec.trace_of(tmp_path / "missed.mcap", *rec.whole_run()[:-2], rec.status(ticks=100, missed=300))
    assert measure(most).robots[0].missed_share == pytest.approx(0.75), "below one"


def test_reserve_is_judged_since_it_came(path, tmp_path):
    robots = rec.PAIR.robots | {"KH01": replace(rec.PAIR.robots["TB01"], standby=True)}
    links = Formation(links={"TB01 - CF01": 1.0, "TB01 - KH01": 1.0})
    linked = rec.pair_with(duration_s=4.0, robots=robots, formation=links)
    never = rec.trace_of(tmp_path / "never.mcap", rec.begun(), *rec.seconds(41), rec.landed(4.0), experiment=linked)
    assert (never.robots, measure(never).failures) == (("TB01", "CF01"), ())
    came = [rec.state("KH01", k, k / 10, 1.0, phase="running" if k >= 15 else "ready") for k in range(10, 41)]
    came += [rec.pose("KH01", k, k / 10) for k in range(13, 40)]  # two before it took part
    trace = rec.trace_of(path, rec.begun(), *rec.seconds(41), *came, rec.landed(4.0), experiment=linked)
    np.testing.assert_allclose(trace.joined, [0.0, 0.0, 1.5], atol=1e-6)
    measured = measure(trace)
    first, _, added = measured.robots
    assert (added.known, added.coverage, first.coverage, added.f_hz) == pytest.approx((1.0, 1.0, 1.0, 25 / 2.5))
    assert (measured.died, measured.failures) == ((), ())


def figures(path, *messages, **more):
    case = measure(rec.trace_of(path, *messages, **more))
    of_robots = [(robot.iae, robot.messages, robot.received, robot.known) for robot in case.robots]
    return of_robots, case.deliveries, case.lost


RUN = rec.whole_run()
DOUBLED = {
    "all twice": [each for each in RUN for _ in range(2)],
    "receipts thrice": [replace(each, received=each.received * 3) if isinstance(each, State) else each for each in RUN],
    "robots of no experiment": [*RUN, *[replace(each, robot="XX99") for each in RUN if isinstance(each, State | Pose)]],
    "second start": [*RUN, rec.begun(0.5)],
}


@pytest.mark.parametrize("messages", DOUBLED.values(), ids=DOUBLED)
def test_repeated_and_foreign_messages_change_no_figure(path, tmp_path, messages):
    assert figures(path, *messages) == figures(tmp_path / "whole.mcap", *RUN)


@pytest.mark.parametrize("place", [(1e300, 0.0, 0.0), (float("nan"),) * 3])
def test_impossible_places_are_unknown(path, tmp_path, place):
    odd = next(k for k, each in enumerate(RUN) if isinstance(each, State) and each.stamp > rec.START + 0.45)
    assert RUN[odd].robot == "TB01"
    changed = replace(RUN[odd], position=place, true_position=place)
    found = figures(path, *RUN[:odd], changed, *RUN[odd + 1 :], experiment=rec.PACKED)
    whole = figures(tmp_path / "whole.mcap", *RUN)
    assert found[0][0][0] == pytest.approx(whole[0][0][0])  # a hole of less than a second is drawn over
    assert found[1:] == whole[1:]


def test_recording_that_broke_off_late_is_interrupted(path, tmp_path):
    """0.4 s before its end, without a word of a landing; robots that landed by themselves are whole."""
    landing = rec.state("TB01", 9, 1.5, phase="landing")
    files, ends = (path, tmp_path / "landed.mcap"), ([], [landing])
    broken, landed = (
        measure(rec.trace_of(file, rec.begun(), *rec.seconds(7), *end)) for file, end in zip(files, ends, strict=True)
    )
    assert (broken.interrupted, broken.duration_s, landed.interrupted) == (True, pytest.approx(0.6, abs=0.11), False)


def test_two_recordings_of_one_case_are_told(tmp_path):
    for name in ("only", "only-recovered"):
        rec.write(tmp_path / f"{name}.mcap", *rec.whole_run())
    rec.write(tmp_path / "other.mcap", rec.begun(), *rec.seconds(11), rec.landed(), case="other", seed=9)
    notes = " ".join(reopen(tmp_path).notes)
    assert "only: several recordings are of this case; shown is only-recovered.mcap" in notes
    assert "different seeds: only 4, other 9" in notes
