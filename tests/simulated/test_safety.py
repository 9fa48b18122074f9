"""Promises of docs/safety.md, by the exact clock of the simulated laboratory."""

from dataclasses import replace
from itertools import pairwise
from math import inf

import pytest

from tests.cases import mostly_slow
from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import AT_S, DRONE, PAIR, TICK_S, TRIO, body, hall
from tests.simulated.world import LOOK_S

FLIER, WHEELS = "crazyflie", "khepera4"
WORLD = DRONE.replace("hover = 0.8", 'hover = 0.8, body = "world"')
LOST = "its own position is lost"
SILENT = "no connection to a router"
ASKED = "it asked who owns its name"
SOON_S = 2.5 * TICK_S  # the robot reads its body, decides and tells
HEARD_S = 0.1  # delay of an event, with the look of the conductor every 0.05 s


def at(since, *texts):
    """Changes of a hazard, each not before a time since the fault [s], and then at once."""
    return [
        (since + later, since + later + SOON_S, text) for later, text in zip((0.0, *[0.0] * 9), texts, strict=False)
    ]


# kind, fault, and hazards of the robot: earliest and latest time since the fault [s], and how the text begins
ROWS = {
    "flies_away": (FLIER, body(("drift", 2.0)), [
        (0.08, 0.2, "warn: it is beyond a wall"), (0.2, 0.3, "land: it left the arena: 0.2"),
        (0.55, 0.65, "cut: it flies away"), (1.1, 1.3, "over: it is beyond a wall"),
    ]),
    "blind": (FLIER, body("nan"), [*at(0.0, f"hold: {LOST}: none"), *at(0.3, f"land: {LOST}")]),
    "stale": (FLIER, body("silent"), [*at(0.5, f"hold: {LOST}: the last is 0.5"), *at(0.8, f"land: {LOST}")]),
    "jump": (FLIER, body(("jump", 1.0)), [*at(0.0, f"hold: {LOST}: it jumped by 1.0"), *at(0.3, f"land: {LOST}")]),
    "far_jump": (FLIER, body(("jump", 30.0)), [*at(0.0, f"hold: {LOST}: it jumped"), *at(0.3, f"land: {LOST}")]),
    "outlier": (FLIER, body(("jump", 1.0), 0.25), [*at(0.0, f"hold: {LOST}"), *at(1.23, f"over: {LOST}")]),
    "blind_wheels": (WHEELS, body("nan", 2.0), [*at(0.0, f"hold: {LOST}: none"), *at(2.98, f"over: {LOST}")]),
    "tilt": (FLIER, body(("tilt", 1.3)), at(0.1, "cut: it has tipped over: it leans 74°")),
    "overspeed": (FLIER, body(("speed", 9.0)), [*at(0.2, "hold: it moves faster"), *at(1.0, "land: it moves faster")]),
    "battery": (FLIER, body(("battery", 0.05)), at(1.0, "land: its battery is low: 5%")),
    "sagging": (FLIER, body(("battery", 0.05), 0.9), []),
    "motors": (FLIER, body("motors"), at(0.0, "land: it came down by itself: its motors are off")),
    "sinking": (FLIER, body(("sink", 0.2)), at(0.1, "land: it comes down by itself: 0.20 m below")),
    "straying": (FLIER, body(("drift", 0.5)), [(1.3, 1.6, "land: it moves without a command")]),
    "mute": (FLIER, body("mute"), [*at(1.0, "warn: its device does not answer"), (3.9, inf, "unresolved at the end")]),
    "stuck_wheels": (WHEELS, body("stuck"), [
        (2.2, 2.45, "warn: it does not obey commands to move"), (4.2, 4.45, "land: it does not obey commands to move"),
    ]),
}  # fmt: skip
DRIVE = """
[[timeline]]
at_s = 0.5
robot = "stuck_wheels"
plan = { kind = "line", move_by = [0.0, 2.0], speed = 0.7 }
"""
LONG_ROWS = {
    "cut_off": (FLIER, Fault(AT_S, "cut", lasts=14.0), [
        (1.3, 1.8, f"hold: {SILENT}"), (10.3, 10.8, f"land: {SILENT}"),
    ]),
    "cut_wheels": (WHEELS, Fault(AT_S, "cut", lasts=14.0), [
        (1.3, 1.8, f"hold: {SILENT}"), (10.3, 10.8, f"land: {SILENT}"),
    ]),
    "cut_shortly": (FLIER, Fault(AT_S, "cut", lasts=2.5), [
        (1.3, 1.8, f"hold: {SILENT}"), (2.5, 3.0, f"hold: {ASKED}"), (2.5, 4.6, f"over: {SILENT}"),
        (2.5, 4.6, f"over: {ASKED}"),
    ]),
    "hardly_cut": (FLIER, Fault(AT_S, "cut", lasts=0.9), [
        (0.9, 1.4, f"hold: {ASKED}"), (1.9, 2.6, f"over: {ASKED}"),
    ]),
}  # fmt: skip


def fly_rows(rows, duration_s, end=""):
    """Hazards of the robots of some rows, in seconds after the fault of each row."""
    faults = [replace(fault, who=name) for name, (_, fault, _) in rows.items()]
    flight = fly(hall({name: kind for name, (kind, *_) in rows.items()}, duration_s, end), *faults)
    assert flight.crashes == []
    assert all(flight.robots[name].off() < duration_s + 2.5 for name, (kind, *_) in rows.items() if kind == FLIER)
    return {name: [(t - AT_S, text) for t, text in flight.robots[name].hazards] for name in rows}


def check_row(name, found):
    expected = {**ROWS, **LONG_ROWS}[name][-1]
    assert len(found) == len(expected), found
    for (earliest, latest, begin), (t, text) in zip(expected, found, strict=True):
        assert text.startswith(begin)
        assert earliest - 1e-6 <= t <= latest, text


@pytest.fixture(scope="module")
def hazards():
    return fly_rows(ROWS, 5.6, DRIVE) | fly_rows(LONG_ROWS, 12.5)


@pytest.mark.parametrize("name", mostly_slow([*ROWS, *LONG_ROWS], 4))
def test_hazard_of_one_robot(name, hazards):
    check_row(name, hazards[name])


def test_lost_neighbour_is_left_out_after_a_second():
    killed, frozen = AT_S, 2.505
    flight = fly(TRIO, Fault(killed, "kill", "C"), Fault(frozen, "pause", "B", lasts=9.0), settings=["duration_s=6"])
    robot = flight.robots["A"]
    t = next(t for t, missing in robot.missing if t > 0.0 and "C" in missing)
    assert killed < t < killed + 0.1 + HEARD_S
    t = next(t for t, missing in robot.missing if t > 0.0 and "B" in missing)
    assert frozen + 1.2 - 0.6 < t < frozen + 1.5
    warned, alone = [
        each for each in robot.hazards if each[1].startswith(("warn: a neighbour is lost: C", "hold: all"))
    ]
    assert warned[0] == pytest.approx(killed + 1.0, abs=SOON_S)
    assert alone[0] == pytest.approx(t + 1.0, abs=HEARD_S)


def test_suspended_robot_holds_until_it_hears():
    shortly, long_s = Fault(AT_S, "pause", "A", lasts=0.45), Fault(AT_S, "pause", "B", lasts=0.7)
    flight = fly(TRIO, shortly, long_s)
    assert not [text for _, text in flight.robots["A"].hazards if "stood still" in text]
    (t, hold), (over, end) = [each for each in flight.robots["B"].hazards if "stood still" in each[1]]
    assert hold.startswith("hold: its process stood still: for 0.")
    assert AT_S + 0.7 <= t < AT_S + 0.7 + 0.25, "it asks for the owner of its name first"
    assert t < over < t + 1.0 + 1.0 + SOON_S
    assert end.startswith("over: ")


def test_robot_on_wheels_drives_on_while_suspended():
    """Seed 120907: after it woke it met another one, before it knew whether its body was its own."""
    asleep = Fault(AT_S, "pause", "A", lasts=4.3)
    world = PAIR.replace("-0.5, 0.0]", '-0.19, 0.0], body = "world"').replace(
        '"A - B" = 0.9 }', '"B > A" = 0.1 }\nleader = "B"'
    )
    flight = fly(world, asleep, settings=["duration_s=7", 'avoidance.kind="barrier"'])
    robot, woken = flight.robots["A"], AT_S + asleep.lasts
    met = next(each.t for each in robot.samples if each.position[0] > 0.5 - 2.0 * 0.07)
    stands = next(each.t for each in robot.samples if each.t > woken and each.velocity[0] < 0.01)
    assert woken < met < stands < woken + 0.7
    assert flight.violations == []


@pytest.mark.parametrize("since", ["ready", "landing"])
def test_computer_that_slept_lands_its_robots(since):
    """Its conductor killed the processes of robots in mid-air: their time to land was over when it went on."""
    asleep = [Fault(0.5, "pause", name, lasts=30.0, since=since) for name in ("A", "C", "router", "conductor")]
    flight = fly(DRONE, *asleep)
    assert flight.code == 2
    assert "this process stood still for more than 3 s" in flight.output
    assert flight.robots["C"].motors[-1][1] is False
    assert [each.code for each in (*flight.of("default-A"), *flight.of("default-C"))] == [0, 0]
    assert not [text for _, text in flight.robots["C"].hazards if "it does not rise" in text]


def test_landing_from_a_high_ceiling_gets_its_time():
    """A climb and a landing had 15 s: the process was killed 17 s after the order, with its motors on."""
    high = DRONE.replace("hover = 0.8", "hover = 7.0").replace('{ "A - C" = 1.1 }', "{}")
    flight = fly(high, settings=["arena.size=[4.0, 4.0, 8.0]", "rates.body_hz=50"])
    assert (flight.code, flight.of("default-C")[0].code) == (0, 0)
    assert flight.robots["C"].off() > 3.0 + 15.0


def test_second_process_ends_without_a_command():
    flight = fly(TRIO, Fault(AT_S, "twice", "A"), settings=["duration_s=5"])
    (second,) = flight.of("second A")
    assert second.code == 2
    assert "a robot of this name is on the network already" in second.output
    assert second.pid not in {pid for _, pid in (*flight.robots["A"].commands, *flight.robots["A"].poses)}
    assert (flight.code, flight.robots["A"].hazards) == (0, [])


def test_two_processes_that_claim_a_name_at_once():
    """The later one began a hundred seconds earlier, by its clock."""
    both = Fault(1.0, "twice", "C", 0.0), Fault(1.001, "twice", "C", -100.0)
    flight = fly(TRIO, Fault(0.5, "kill", "C"), *both, settings=["duration_s=4"])
    robot, seconds = flight.robots["C"], flight.of("second C")
    drivers = {pid for t, pid in (*robot.poses, *robot.commands) if t > 1.0}
    assert drivers == {each.pid for each in seconds if each.code != 2}
    assert ["on the network already" in each.output for each in seconds if each.pid not in drivers] == [True]
    assert (len(drivers), flight.violations) == (1, [])


def test_second_process_takes_a_free_name():
    """Others know that the name is alive, though the process that the run has started is not."""
    twice, kill = Fault(0.4, "twice", "C", since="launch"), Fault(0.3, "kill", "C", since="ready")
    settings = ["duration_s=9", 'start.missing="go-on"', "start.deadline_s=3"]
    flight = fly(TRIO, twice, kill, settings=settings)
    (second,) = flight.of("second C")
    assert [each.phase for each in flight.robots["C"].phases if each.pid == second.pid][:2] == ["idle", "ready"]
    assert (flight.code, second.code, flight.violations) == (1, 0, [])


# end of a cut in which another process takes the name, end of the former owner's process, and more faults
DISPLACED = {
    "long cut": (3.5, 6.0, ()),
    "cut as long as the lease": (1.944, 4.444, ()),  # seed 70470: its link is opened anew between two ticks
    "cut off again": (3.5, 6.0, [Fault(3.6, "cut", "A", lasts=3.5)]),
    "in a loop that hangs": (3.5, 12.45, [Fault(3.45, "hang", "A", 9.0)]),
}


@pytest.mark.parametrize(("back", "end", "more"), DISPLACED.values(), ids=DISPLACED)
def test_former_owner_commands_nothing(back, end, more):
    cut, twice = Fault(0.5, "cut", "A", lasts=back - 0.5), Fault(0.54 * back, "twice", "A")
    flight = fly(TRIO, cut, twice, *more, settings=["duration_s=7"])
    robot, former, (second,) = flight.robots["A"], flight.of("default-A")[0], flight.of("second A")
    assert [t for t, pid in robot.poses if pid == second.pid and t < back]
    late = [t for t, pid in (*robot.poses, *robot.commands) if pid == former.pid and t > back + TICK_S]
    assert late == []
    assert not flight.happened("hazard", "A", "its control loop hangs")
    assert (former.code, flight.violations) == (2, [])
    assert end - 1e-6 <= former.ended < end + 0.5


def test_router_is_lost_after_its_last_words():
    """A suspended router's messages came up to 2 s later over a slow link, and the rule did not wait (seed 150012)."""
    slow, silent = Fault(0.5, "slow", "A", 1500, 9.0), Fault(1.5, "pause", "router", lasts=6.0)
    assert fly(TRIO, slow, silent, settings=["duration_s=5"]).violations == []


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_loop_misses_its_router_as_soon(seed):
    """Slow loops looked for the router on some ticks alone: robots held after 2.8 s, or not at all (seed 504632)."""
    slow, silent = Fault(1.0, "late", "C", 0.05, 9.0), Fault(1.2, "pause", "router", lasts=9.0)
    flight = fly(DRONE, slow, silent, settings=["duration_s=5"], seed=seed)
    held = next(t for t, text in flight.robots["C"].hazards if text.startswith(f"hold: {SILENT}"))
    assert 1.2 + 1.3 < held < 1.2 + 2.5


@pytest.mark.parametrize("seed", [4, 5])
def test_twin_stands_still_while_its_process_asks(seed):
    """Answers took seconds, over a slow link, and a rule missed progress of the landing (seed 150074)."""
    high = DRONE.replace("hover = 0.8", "hover = 1.8")
    flight = fly(high, Fault(1.5, "slow", "C", 1500, 30.0), seed=seed)
    (landing,) = flight.robots["C"].entered("landing")
    assert landing + 12.0 < flight.robots["C"].off() < landing + 10.0 + 6.0
    assert flight.violations == []


def test_robot_without_an_answer_about_its_owner_lands():
    """A process without an answer waited anew before each tick, thus for good."""
    flight = fly(DRONE, Fault(0.5, "slow", "C", 1500, 60.0), settings=["duration_s=20"], seed=3)
    robot = flight.robots["C"]
    commands = [t for t, _ in robot.commands]
    asked_s, over = max((next_t - t, next_t) for t, next_t in pairwise(commands))
    assert 10.0 < asked_s < 10.1
    assert robot.entered("landing") == [pytest.approx(over, abs=SOON_S)]
    assert over < robot.off() < over + 2.5
    assert flight.violations == []


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_wait_for_an_answer_begins_once(seed):
    """A link that was lost and came back began the wait anew, without a command in between (seed 811752)."""
    asleep, slow = Fault(1.0, "pause", "C", lasts=5.0), Fault(5.7, "slow", "C", 1800, 60.0)
    flight = fly(DRONE, asleep, slow, settings=["duration_s=20"], seed=seed)
    robot = flight.robots["C"]
    over = min(t for t, _ in robot.commands if t > 6.0)
    assert 6.0 + 10.0 < over < 6.0 + 10.1
    assert robot.entered("landing") == [pytest.approx(over, abs=SOON_S)]
    assert flight.violations == []


SHORTLY_SILENT = Fault(0.5, "pause", "router", lasts=1.5), Fault(0.5, "cut", "A", lasts=1.0)


@pytest.mark.parametrize("fault", SHORTLY_SILENT, ids=str)
def test_robot_asks_for_its_owner_before_anything_else(fault):
    """The link outlives both."""
    flight = fly(TRIO, fault, settings=["duration_s=5"])
    back = fault.at + fault.lasts
    sent = [t for t, _ in (*flight.robots["A"].poses, *flight.robots["A"].commands) if t > back + TICK_S]
    assert back + 0.2 < min(sent) < back + 0.2 + 0.15
    assert (flight.code, flight.violations) == (0, [])


def test_robot_tells_that_another_process_had_its_name():
    cut, killed = Fault(0.5, "cut", "A", lasts=4.0), Fault(5.5, "kill", "second A")
    flight = fly(TRIO, cut, Fault(1.0, "twice", "A"), killed, settings=["duration_s=9"])
    (asked,) = flight.happened("hazard", "A", "hold: it asked who owns its name: for 1.2 s; another process had it")
    assert asked.t == pytest.approx(killed.at + 0.2, abs=0.1)
    assert max(t for t, _ in flight.robots["A"].commands) > 9.0
    assert (flight.code, flight.violations) == (3, [])


@pytest.mark.parametrize("seed", mostly_slow([1, 2], 2))
def test_two_robots_of_a_process_keep_their_names(seed):
    """They hear each other, and such a session gets empty answers to its questions about tokens."""
    back = 3.5
    pair = TRIO.replace("-0.3] }", '-0.3], process = "pair" }')
    cut = Fault(0.5, "cut", "A", lasts=back - 0.5)
    alone = fly(pair, cut, settings=["duration_s=7"], forgets=0.5, seed=seed)
    assert [each.reason for name in "AB" for each in alone.robots[name].phases[-1:]] == ["finished"] * 2
    assert max(t for track in alone.robots.values() for t, text in track.hazards) < back + 2.5
    taken = fly(pair, cut, Fault(1.9, "twice", "A"), settings=["duration_s=7"], forgets=0.5, seed=seed)
    former = taken.of("default-pair")[0]
    used = [(*taken.robots[name].poses, *taken.robots[name].commands) for name in "AB"]
    assert not [t for rows in used for t, pid in rows if pid == former.pid and t > back + TICK_S]
    assert (former.code, taken.violations) == (2, [])


def test_hanging_loop_is_landed_then_cut():
    flight = fly(DRONE, Fault(AT_S, "hang", "C", 100.0), settings=["duration_s=14", "arena.size=[4.0, 4.0, 2.5]"])
    (process,) = flight.of("default-C")
    (told,) = flight.happened("hazard", "C")
    assert told.text.startswith("land: its control loop hangs: no tick for 0.")
    assert AT_S + 0.5 < told.t < AT_S + 0.7 + HEARD_S
    assert AT_S + 0.5 <= next(t for t, _ in flight.robots["C"].commands if t > AT_S + 0.1) < AT_S + 0.7
    assert flight.robots["A"].missing[-1][1] == ("C",)
    assert AT_S + 0.5 + 12.5 < process.ended < AT_S + 0.7 + 12.5 + 1.0  # 2.5 m at 0.2 m/s
    assert process.code == 70
    assert flight.robots["C"].off(after=process.ended) == process.ended


@pytest.mark.parametrize("body", ["world", "twin"])
def test_hanging_loop_lands_all_its_robots(body):
    """Seeds 130158 and 130909: a twin in the process stands still with the loop, on the way down too."""
    both = DRONE.replace('"khepera4", ', '"crazyflie", hover = 0.8, ').replace(
        "0.8", f'0.8, body = "{body}", process = "g"'
    )
    flight = fly(both, Fault(0.4, "hang", "A", 12.0, since="landing"))
    begun = flight.happened("phase", text="landing")[0].t + 0.4
    for robot in flight.robots.values():
        assert begun + 0.5 <= next(t for t, _ in robot.commands if t > begun + 0.1) < begun + 0.7
        assert (robot.off() < begun + 2.0) == (body == "world")
    assert flight.violations == []


def test_body_that_cannot_be_read_is_landed():
    flight = fly(DRONE, Fault(AT_S, "body", "C", "error"))
    off = flight.robots["C"].off(after=AT_S)
    assert AT_S + 1.0 < off < AT_S + 2.5
    assert flight.robots["C"].at(off - 0.1).position[2] < 0.1
    assert flight.happened("robot", "C", "landing: its control loop broke: OSError")
    assert (flight.code, flight.violations) == (1, [])


def test_landing_by_a_hazard_is_lost_at_once():
    flight = fly(DRONE, Fault(AT_S, "body", "C", ("battery", 0.05)))
    lands = flight.robots["C"].entered("landing")[0]
    assert not [t for t, _ in flight.robots["C"].poses if lands + TICK_S < t < 3.0]
    assert lands < next(t for t, missing in flight.robots["A"].missing if t > 0.0 and missing == ("C",)) < lands + 0.15
    assert (flight.code, flight.violations) == (1, [])


def test_lost_order_to_land_is_repeated():
    end, lost = 3.0, 5.3
    flight = fly(DRONE, Fault(end - 0.5, "body", "C", "aloft", lost - end + 0.5))
    assert end + 2.0 < lost < end + 2.0 + 1.0, "the first two are"
    assert end + 3.0 + 1.5 < flight.robots["C"].off() < end + 3.0 + 2.5
    assert (flight.code, flight.violations) == (0, [])


def test_second_process_hides_no_robot():
    """The rules look at the robot that flies, not at the twin of a process that asks for its name."""
    deaf = Fault(AT_S, "body", "C", "deaf")
    flight = fly(DRONE, Fault(AT_S, "twice", "C"), deaf, Fault(2.0, "estop"), settings=["duration_s=4"])
    assert flight.of("second C")[0].ended > 3.0
    (told,) = [each for each in flight.violations if each.rule == "emergency-stop"]
    assert 2.3 < told.t < 2.3 + 2.0 * LOOK_S
    assert [on for _, on in flight.robots["C"].motors] == [True]


CASES = '\n[cases]\nfirst.trigger = "periodic"\nsecond.trigger = "periodic"\n'


def test_emergency_stop_ends_the_run():
    flight = fly(DRONE + CASES, Fault(AT_S, "estop"))
    assert flight.robots["C"].off(after=AT_S) < AT_S + 0.005, "in the receiving thread, before the next tick"
    assert flight.robots["C"].phases[-1].reason.startswith("emergency stop")
    assert flight.code == 1
    assert "zenpark: emergency stop by operator: zenpark estop" in flight.output
    answer = flight.answers[0]
    assert (answer.code, answer.output.partition(" (")[0]) == (0, "stopped: A, C"), "by network and the run's process"
    assert not [each for each in flight.processes if each.name.startswith("second-")]


def test_stop_without_router_goes_by_lifelines():
    asleep = 3.505
    stood = Fault(1.0, "pause", "router", lasts=20.0), Fault(1.2, "pause", "A", lasts=asleep - 1.2)
    flight = fly(DRONE, *stood, Fault(1.505, "estop"), settings=["duration_s=6"])
    assert flight.robots["C"].off(after=1.505) < 1.505 + 0.1
    done = flight.robots["A"].entered("done")[0]
    assert asleep < done < asleep + 0.5 + 0.2
    assert [phase.reason for phase in flight.robots["A"].phases][-1].startswith("emergency stop")
    assert flight.code == 1


def test_stop_that_no_body_obeys_is_told():
    flight = fly(DRONE, Fault(0.0, "body", "C", "deaf"), Fault(AT_S, "estop"), settings=["rates.body_hz=50"])
    (answer,) = flight.answers
    assert answer.code == 1
    assert "NOT known to have stopped: C" in answer.output
    (lost,) = flight.happened("lost", "C", "did not end its landing within 15 s")
    (process,) = flight.of("default-C")
    assert process.ended == pytest.approx(lost.t + 5.0, abs=0.2)
    assert flight.code == 1


def test_stop_that_no_body_confirms_is_told():
    flight = fly(WORLD, Fault(AT_S, "pause", "world", lasts=60.0), Fault(AT_S, "estop"), settings=["rates.body_hz=50"])
    (stop,) = flight.happened("stop")
    (told,) = flight.happened("body", "C", "the emergency stop is not answered")
    assert stop.t + 2.5 - HEARD_S < told.t < stop.t + 2.5 + HEARD_S


UNHEARD = {
    "robot cut off": Fault(AT_S, "cut", "C", lasts=9.0),
    "robot suspended": Fault(AT_S, "pause", "C", lasts=9.0),
    "world cut off": Fault(AT_S, "cut", "world", lasts=9.0),
    "messages of the world lost": Fault(AT_S, "loss", "world", 0.9, 9.0),  # seed 120567
    "router suspended": Fault(AT_S, "pause", "router", lasts=9.0),
}


@pytest.mark.parametrize("fault", UNHEARD.values(), ids=UNHEARD)
def test_world_obeys_a_stop_itself(fault):
    """Orders of its robots had to reach it: motors stayed on for up to 8.7 s."""
    flight = fly(WORLD, fault, Fault(1.505, "estop"), settings=["rates.body_hz=50"])
    assert flight.robots["C"].off(after=1.505) < 1.505 + 0.1
    assert flight.violations == []


REPEATED = {
    "stop": (Fault(AT_S, "order", "C", "stop"), 0.35),
    "land": (Fault(AT_S, "order", "C", "land"), 2.3),
    "broken loop": (Fault(AT_S, "body", "C", "error"), 2.6),
}


@pytest.mark.parametrize(("fault", "limit_s"), REPEATED.values(), ids=REPEATED)
def test_orders_are_repeated_on_every_tick(fault, limit_s):
    """Ten times a second: motors stayed on for up to 3.2 s after a stop (seeds 160297 and 503847)."""
    lossy = Fault(0.9, "loss", "world", 0.9, 9.0)
    for seed in range(1, 5):
        flight = fly(WORLD, lossy, fault, seed=seed)
        assert flight.robots["C"].off(after=AT_S) < AT_S + limit_s
        assert flight.violations == []


@pytest.mark.parametrize("spoils", ["", "cut", "loss"])
def test_robot_ordered_down_in_its_climb_lands(spoils):
    """Below 5 cm and slow it counted as landed, and its order was not repeated any more (seed 132407)."""
    spoilt = [Fault(0.55, spoils, "world", 0.9, 0.4 if spoils == "cut" else 2.0, since="ready")] if spoils else []
    flight = fly(WORLD, *spoilt, Fault(0.6, "order", "C", "land", since="ready"), settings=["rates.body_hz=50"])
    robot = flight.robots["C"]
    assert robot.off() < robot.entered("done")[0] < robot.off() + 1.2
    assert flight.violations == []


def test_robot_that_was_ordered_to_hold_holds():
    flight = fly(
        DRONE, Fault(0.5, "order", "A", "hold", since="ready"), Fault(AT_S, "order", "C", "hold"),
        Fault(2.0, "order", "A", "start"), Fault(2.5, "order", "C", "resume"), settings=["duration_s=4"],
    )  # fmt: skip
    (held, _), (over, _) = flight.robots["A"].hazards
    assert held < 0.1, "the common start ends no hold"
    assert 2.0 < over < 2.0 + 1.0 + HEARD_S
    (held, text), (over, _) = flight.robots["C"].hazards
    assert text == "hold: ordered: by an operator"
    assert AT_S < held < AT_S + HEARD_S
    place = flight.robots["C"].at(held + 0.5).position
    assert flight.robots["C"].at(2.5).position == pytest.approx(place, abs=0.03)
    assert 2.5 < over < 2.5 + 1.0 + HEARD_S
