"""Positions by a clock that is off: what is stamped ahead hides no silence, and people are told how far it is off."""

from math import inf, isnan, nan
from random import Random
from types import SimpleNamespace

import pytest

from agents.body.external_pose import FASTEST, PATIENCE_S, External
from agents.body.interface import BodyState
from agents.body.measured_positions import FROZEN, LATE, NOTHING, NOTHING_S, SECOND, MeasuredPositions
from agents.decision.lifecycle import Phase
from agents.network import messages
from agents.network.keys import Keys
from agents.vectors import UNKNOWN, ZERO
from experiments.definition.experiment import RobotTable
from tests.agents.runtime.process import process, twins
from tests.fuzz.messages import sent
from tests.network import Net, Sample
from tests.small import small

KEYS = Keys("park")
UTC = 1.8e9
DT = 0.01
PLACE = (0.1, 0.2, 0.0)


def position(stamp, place=PLACE, robot="T"):
    return sent(KEYS.position("T"), messages.Position(robot, stamp, place, 0.3))[0]


def listening(net, names=("A", "T"), silence_s=0.5, **given):
    rows = [len(names) - 1]
    return MeasuredPositions(net.session, KEYS, names, rows, (9.0, 9.0, 9.0), silence_s=silence_s, **given)


def test_stamps_ahead_count_as_now_and_are_reported():
    net = Net()
    with net.worn():
        heard = listening(net, exact=[1])
        assert all(isnan(source.ahead) for source in heard.sources.values())
        for ahead, taken in ((-0.02, [7.98]), (2.3, [8.0]), (3600.0, []), (-7.0, [1.0])):
            net.deliver(position(UTC + 8.0 + ahead))
            assert [when for _, when, *_ in heard.receive(UTC, 8.0)] == pytest.approx(taken, abs=1e-6)
            assert heard.sources[1].ahead == pytest.approx(ahead, abs=1e-6)
        net.deliver(position(UTC, robot="A"))
        assert not list(heard.receive(UTC, 8.0))
        assert heard.sources[1].ahead == pytest.approx(-7.0, abs=1e-6), "of another robot"
        assert (heard.malformed, heard.sources[1].inbox.trouble) == (2, "position of 'A' on the key of 'T'")


def flight_events(ahead, seconds, frozen_s=inf):
    """A Tello at 100 Hz whose positions are stamped `ahead(t)` of t [s] (None: there are none); what was said, when.

    From `frozen_s` on they stay the same.
    """
    tello = small({"T": RobotTable(kind="tello", start=[0.1, 0.2], hover=0.5, position="external")})
    said, measured, noise, net = [], ZERO, Random(1), Net()
    with net.worn():
        body = twins(tello)
        runtime = process(tello, body, externally_measured=[True])
        body.open()
        runtime.subscribe_to_stops(net.session)
        runtime.join(net.session)
        (robot,) = runtime.robots
        for tick in range(1, round(seconds / DT)):
            t = tick * DT
            if (off := ahead(t)) is not None:
                seen = runtime.states[0].true_position if runtime.states else PLACE
                measured = tuple(value + noise.gauss(0.0, 1e-4) for value in seen) if t < frozen_s else measured
                net.deliver(position(t + off, measured))
            runtime.tick(t)
            if robot.lifecycle.phase == Phase.READY:
                robot.lifecycle.takeoff()
            worst = robot.hazards.worst()
            if worst and (not said or said[-1][1] != worst):
                said.append((t, worst))
    return runtime, said


@pytest.mark.parametrize("ahead", [0.0, 2.0, 4.5])
def test_blindness_is_noticed_in_time_despite_stamps_ahead(ahead):
    silent = 3.0
    _, said = flight_events(lambda t: ahead if t < silent else None, 4.5)
    blind, text = next((t, text) for t, text in said if "its own position is lost" in text)
    assert blind == pytest.approx(silent + 0.5, abs=0.03)
    assert text.startswith("hold: its own position is lost: the last is 0.5")
    warned = [text for _, text in said if "clock" in text and text.startswith("warn")]
    told = f"warn: the clock that stamps its positions is off: positions of T are stamped {ahead:g} s ahead"
    assert warned == ([told] if ahead else [])


def test_stamps_behind_are_reported_before_positions_expire():
    _, said = flight_events(lambda t: 0.0 if t < 2.0 else -0.4, 4.0)
    (t, text), *_ = [each for each in said if "clock" in each[1]]
    assert t == pytest.approx(2.5, abs=0.03)
    assert text.endswith("positions of T are stamped 0.4 s behind")
    assert not any("position is lost" in text for _, text in said)
    runtime, _ = flight_events(lambda _: -3600.0, 0.5)
    assert runtime.robots[0].lifecycle.reason == "no position of its own: positions of T are stamped 3.6e+03 s behind"


@pytest.mark.parametrize(("frozen_s", "phase"), [(0.0, "idle"), (1.2, "done"), (4.0, "done")])
def test_frozen_motion_capture_lands_what_flies(frozen_s, phase):
    runtime, said = flight_events(lambda _: 0.0, frozen_s + 7.0, frozen_s)
    assert Phase(runtime.robots[0].lifecycle.phase).word == phase
    assert runtime.states[0].note == FROZEN
    if frozen_s:
        (held, text), (landed, _), *_ = [each for each in said if "its own position is lost" in each[1]]
        assert text.startswith("hold: its own position is lost: the last is 0.5")
        assert [held - frozen_s, landed - frozen_s] == pytest.approx([0.5, 0.8], abs=0.03)


@pytest.mark.parametrize(("delay_s", "taken", "note"), [(0.14, 49, ""), (0.16, 0, LATE.format(0.16, 0.15))])
def test_late_positions_are_refused_and_named(delay_s, taken, note):
    net, state = Net(), BodyState()
    with net.worn():
        heard, used = listening(net, late_s=[inf, 0.15]), 0
        for tick in range(50):
            t = 8.0 + DT * tick
            net.deliver(position(UTC + t - delay_s, (0.1 + 0.001 * tick, 0.2, 0.0)))
            used += len(list(heard.receive(UTC, t)))
        heard.annotate([BodyState(), state], t)
    assert (used, heard.malformed, state.note) == (taken, 49 - taken, note)


def test_places_beyond_any_room_are_named_in_flight():
    """A unit that changes: metres, then millimetres."""
    net, state = Net(), BodyState()
    with net.worn():
        heard = listening(net)
        for tick in range(80):
            t, scale = 8.0 + DT * tick, 1.0 if tick < 40 else 1000.0
            net.deliver(position(UTC + t, (scale * (0.1 + 0.001 * tick), 0.2, 0.0)))
            list(heard.receive(UTC, t))
        heard.annotate([BodyState(), state], t)
    assert state.note.startswith("what comes on park/T/position is refused: ")


def test_single_late_position_is_no_fault():
    net, state = Net(), BodyState()
    with net.worn():
        heard = listening(net, late_s=[inf, 0.15])
        for tick, delay_s in enumerate([0.0, 0.0, 0.0, 0.4]):
            net.deliver(position(UTC + 8.0 + 0.1 * tick - delay_s, (0.1 + 0.001 * tick, 0.2, 0.0)))
            taken = list(heard.receive(UTC, 8.0 + 0.1 * tick))
        heard.annotate([BodyState(), state], 8.3)
    assert (taken, state.note) == ([], "")


def test_what_never_comes_is_named_soon():
    net = Net()
    with net.worn():
        heard = listening(net)
        for t, payload, note in (
            (1.0, None, ""),
            (1.0 + NOTHING_S, None, ""),
            (1.1 + NOTHING_S, None, NOTHING.format("park/T/position")),
            (5.0, position(UTC + 5.0, (99.0, 0.0, 0.0)), "what comes on park/T/position is refused: "),
        ):
            if payload is not None:
                net.deliver(payload)
            list(heard.receive(UTC, t))
            state = BodyState()
            heard.annotate([BodyState(), state], t)
            assert state.note.startswith(note)
            assert bool(state.note) == bool(note)


def test_the_first_of_two_sources_stays_until_silent():
    net = Net()
    with net.worn():
        heard = listening(net, ("T",), 0.45)

        def tell(t, *places):
            for session, x in places:
                place = messages.Position("T", UTC + t, (x + 0.001 * t, 0.0, 0.0), 0.3)
                sample = Sample(KEYS.position("T"), messages.JSON, messages.encode(place, "json"))
                sample.source_info = SimpleNamespace(source_id=SimpleNamespace(zid=session))
                for channel in net.channels:
                    channel.add(sample)
            return [round(float(position[0])) for _, _, position, _ in heard.receive(UTC, t)]

        both = [("a", 1.0), ("b", 2.0)]
        taken = [tell(8.0 + 0.1 * tick, *both) for tick in range(4)]
        assert taken == [[], [1], [1], [1]]
        assert heard.malformed == 4
        state = BodyState(note="locked")
        heard.annotate([state], 8.4)
        assert (state.note, state.ahead) == (f"{SECOND}; locked", pytest.approx(0.0, abs=1e-6))
        taken = [tell(8.4 + 0.1 * tick, ("b", 2.0)) for tick in range(8)]
        assert taken == [[]] * 5 + [[2]] * 3
        assert tell(9.2, *both) == [2], "the first one is the second now"
        assert tell(11.0, *reversed(both)) == [2], "nothing was received meanwhile"
        state = BodyState()
        heard.annotate([state], 12.5)
        assert not state.note


def estimated(t, stamp, position, velocity=UNKNOWN, external=None):
    """Velocity at t [s] of a robot that was at a position at a `stamp` [s]."""
    state = BodyState(stamp, position, velocity, 0.0)
    (external or External()).estimate(t, state)
    return state.velocity


def test_velocity_follows_from_positions():
    external = External()
    found = [estimated(t, t, (0.2 * min(t, 1.0), 0.0, 0.0), external=external) for t in (0.01 * k for k in range(151))]
    assert found[100] == pytest.approx((0.2, 0.0, 0.0), abs=1e-3)
    assert 0.0 <= found[150][0] < 0.003  # it stands now
    assert estimated(0.0, 0.0, ZERO, (0.0, 0.7, 0.0)) == (0.0, 0.7, 0.0), "it is measured"
    external = External()
    assert estimated(0.1, 0.0, ZERO, external=external) == ZERO
    for unknown in (estimated(PATIENCE_S, 0.0, ZERO, external=external), estimated(0.1, 0.0, (nan, 0.0, 0.0))):
        assert all(map(isnan, unknown))


def test_poses_that_are_old_or_jump_are_refused():
    external = External()
    taken = [
        external.update(1.0, ZERO, 0.0),
        external.update(1.0, ZERO, 0.0),
        external.update(1.1, (nan, 0.0, 0.0), 0.0),
        external.update(1.1, (FASTEST * 0.1 + 0.1, 0.0, 0.0), 0.0),
    ]
    assert taken == [True, False, False, False]
    assert (external.refused, external.time) == (1, 1.0)
    assert external.update(1.0 + PATIENCE_S, (9.0, 0.0, 0.0), 0.0)
    assert external.velocity == ZERO


def test_own_yaw_continues_without_measured_yaw():
    external = External()

    def yaw(t, measured, own):
        external.update(t, (0.1 * t, 0.0, 0.0), measured)
        filled = BodyState(t - 0.5, (7.0, 7.0, 7.0), UNKNOWN, own)
        external.fill(filled)
        assert (filled.time, filled.position, filled.velocity) == (t, external.position, external.velocity)
        return filled.yaw

    assert yaw(0.0, nan, 0.3) == 0.3  # none was measured yet
    assert yaw(0.1, 1.0, 0.2) == 1.0
    assert yaw(0.2, nan, 0.7) == pytest.approx(1.5)  # turned by 0.5 since
    assert yaw(5.0, nan, -0.2) == pytest.approx(0.6)
    assert yaw(5.1, 2.0, -0.2) == 2.0
    assert isnan(yaw(5.2, nan, nan))
