"""Positions by a clock that is off: what is stamped ahead hides no silence, and people are told how far it is off."""

from collections.abc import Callable
from math import inf, isnan
from random import Random

import pytest

from agents.body.fleet import assemble
from agents.body.interface import BodyState
from agents.body.measured_positions import FROZEN, SECOND, MeasuredPositions
from agents.decision.lifecycle import Phase
from agents.network import messages
from agents.network.keys import Keys
from agents.runtime.loop import Runtime, Setup
from agents.safety.detection import clock_text
from experiments.definition import bodies
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.agents.runtime.test_pose_inbox import Sample
from tests.fuzz.loopnet import Net
from tests.fuzz.messages import sent

KEYS = Keys("park")
UTC = 1.8e9
DT = 0.01
PLACE = (0.1, 0.2, 0.0)


def position(stamp: float, robot: str = "T") -> bytes:
    return sent(KEYS.position("T"), messages.Position(robot, stamp, PLACE, 0.3))[0]


def test_stamps_ahead_count_as_now_and_are_reported() -> None:
    net = Net()
    with net.worn():
        heard = MeasuredPositions(net.session, KEYS, ("A", "T"), [1], (9.0, 9.0, 9.0), exact=[1], silence_s=0.5)  # type: ignore[arg-type]
        assert all(map(isnan, heard.ahead))
        for ahead, taken in ((-0.02, [7.98]), (2.3, [8.0]), (3600.0, []), (-7.0, [1.0])):
            net.deliver(position(UTC + 8.0 + ahead))
            assert [(row, when) for row, when, *_ in heard.receive(UTC, 8.0)] == [
                (1, pytest.approx(when, abs=1e-6)) for when in taken
            ]
            assert heard.ahead[1] == pytest.approx(ahead, abs=1e-6)
        net.deliver(position(UTC, robot="A"))
        assert not list(heard.receive(UTC, 8.0))
        assert heard.ahead[1] == pytest.approx(-7.0, abs=1e-6), "of another robot"
        assert heard.malformed == [0, 2]
        assert heard.trouble[1] == "position of 'A' on the key of 'T'"


def test_the_text_names_robot_and_size() -> None:
    assert clock_text("CF02", 2.3) == "positions of CF02 are stamped 2.3 s ahead"
    assert clock_text("CF01", -0.4) == "positions of CF01 are stamped 0.4 s behind"


def flown(
    ahead: Callable[[float], float | None], seconds: float, frozen_s: float = inf
) -> tuple[Runtime, list[tuple[float, str]]]:
    """A Tello at 100 Hz whose positions are stamped so far ahead of `t` (None: there are none), and from `frozen_s` on
    the same; what was said, when.
    """
    few = pair(
        robots={"T": RobotTable(kind="tello", start=[0.1, 0.2], hover=0.5, position="external")}, formation=Formation()
    )
    said: list[tuple[float, str]] = []
    measured, noise = (0.0, 0.0, 0.0), Random(1)
    net = Net()
    with net.worn():
        body = assemble(bodies.body_request(Plan(few), ("T",), 1))
        setup = Setup(KEYS, [], "json", 50.0, lifeline=False, externally_measured=[True])
        runtime = Runtime([Plan(few).assignment("T")], body, setup)
        body.open()
        runtime.subscribe_to_stops(net.session)  # type: ignore[arg-type]
        runtime.join(net.session)  # type: ignore[arg-type]
        runtime._utc = runtime._telemetry.utc = UTC
        (robot,) = runtime.robots
        for tick in range(1, round(seconds / DT)):
            t = tick * DT
            if (off := ahead(t)) is not None:
                seen = runtime.states[0].true_position if runtime.states else PLACE
                measured = tuple(value + noise.gauss(0.0, 1e-4) for value in seen) if t < frozen_s else measured
                place = messages.Position("T", UTC + t + off, measured, 0.0)
                net.deliver(sent(KEYS.position("T"), place)[0])
            runtime.tick(t)
            if robot.lifecycle.phase == Phase.READY:
                robot.lifecycle.takeoff()
            worst = robot.hazards.worst()
            if worst and (not said or said[-1][1] != worst):
                said.append((t, worst))
    return runtime, said


@pytest.mark.parametrize("ahead", [0.0, 2.0, 4.5])
def test_blindness_is_noticed_in_time_despite_stamps_ahead(ahead: float) -> None:
    silent = 3.0
    _, said = flown(lambda t: ahead if t < silent else None, 4.5)
    blind, text = next((t, text) for t, text in said if "its own position is lost" in text)
    assert blind == pytest.approx(silent + 0.5, abs=0.03)
    assert text.startswith("hold: its own position is lost: the last is 0.5")
    warned = [text for _, text in said if "clock" in text and text.startswith("warn")]
    told = f"warn: the clock that stamps its positions is off: positions of T are stamped {ahead:g} s ahead"
    assert warned == ([told] if ahead else [])


def test_stamps_behind_are_reported_before_positions_expire() -> None:
    _, said = flown(lambda t: 0.0 if t < 2.0 else -0.4, 4.0)
    (t, text), *_ = [each for each in said if "clock" in each[1]]
    assert t == pytest.approx(2.5, abs=0.03)
    assert text == "warn: the clock that stamps its positions is off: positions of T are stamped 0.4 s behind"
    assert not any("position is lost" in text for _, text in said)


def test_waiting_robot_reports_positions_of_another_clock() -> None:
    runtime, _ = flown(lambda _: -3600.0, 0.5)
    assert runtime.robots[0].lifecycle.reason == "no position of its own: positions of T are stamped 3.6e+03 s behind"


@pytest.mark.parametrize(("exact", "expected"), [([], [8.3]), ([1], [8.0, 8.1, 8.2, 8.3, 8.4])])
def test_a_pose_that_repeats_itself_is_none(exact: list[int], expected: list[float]) -> None:
    net, taken = Net(), []
    with net.worn():
        heard = MeasuredPositions(net.session, KEYS, ("A", "T"), [1], (9.0, 9.0, 9.0), exact=exact, silence_s=0.5)  # type: ignore[arg-type]
        for tick in range(5):
            t = 8.0 + 0.1 * tick
            place = messages.Position("T", UTC + t, (0.1, 0.2, 0.0 if tick < 3 else 0.001), 0.3)
            net.deliver(sent(KEYS.position("T"), place)[0])
            taken += [when for _, when, *_ in heard.receive(UTC, t)]
    assert taken == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("frozen_s", "phase"), [(0.0, "idle"), (1.2, "done"), (4.0, "done")])
def test_frozen_motion_capture_lands_what_flies(frozen_s: float, phase: str) -> None:
    runtime, said = flown(lambda _: 0.0, frozen_s + 7.0, frozen_s)
    assert Phase(runtime.robots[0].lifecycle.phase).word == phase
    assert runtime.states[0].note == FROZEN
    if frozen_s:
        (held, text), (landed, _), *_ = [each for each in said if "its own position is lost" in each[1]]
        assert text.startswith("hold: its own position is lost: the last is 0.5")
        assert [held - frozen_s, landed - frozen_s] == pytest.approx([0.5, 0.8], abs=0.03)


def test_the_first_of_two_sources_stays_until_silent() -> None:
    net, taken = Net(), []
    with net.worn():
        heard = MeasuredPositions(net.session, KEYS, ("T",), [0], (9.0, 9.0, 9.0), silence_s=0.45)  # type: ignore[arg-type]

        def tell(t: float, *places: tuple[str | None, float]) -> list[float]:
            for session, x in places:
                payload = messages.encode(messages.Position("T", UTC + t, (x + 0.001 * t, 0.0, 0.0), 0.3))
                for channel in net.channels:
                    channel.add(Sample(KEYS.position("T"), payload, session=session))
            return [round(float(position[0])) for _, _, position, _ in heard.receive(UTC, t)]

        both: list[tuple[str | None, float]] = [("a", 1.0), ("b", 2.0)]
        taken = [tell(8.0 + 0.1 * tick, *both) for tick in range(4)]
        assert taken == [[], [1], [1], [1]]
        assert heard.malformed == [4]
        state = BodyState(note="locked")
        heard.annotate([state], 8.4)
        assert state.note == f"{SECOND}; locked"
        assert state.ahead == pytest.approx(0.0, abs=1e-6)
        taken = [tell(8.4 + 0.1 * tick, ("b", 2.0)) for tick in range(8)]
        assert taken == [[]] * 5 + [[2]] * 3
        assert tell(9.2, *both) == [2], "the first one is the second now"
        assert tell(11.0, *reversed(both)) == [2], "nothing was received meanwhile"
        state = BodyState()
        heard.annotate([state], 12.5)
        assert not state.note
