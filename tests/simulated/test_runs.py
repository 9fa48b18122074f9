"""Exit codes of `./zenpark run`, as docs/runs.md has them, with the recording that is left."""

from dataclasses import dataclass, field
from math import inf

import pytest

from tests.cases import mostly_slow
from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import DRONE, PAIR, TRIO

LIMIT = '[[criteria]]\nmetric = "f_hz"\nat_most = {}\nwhy = "Few messages are wanted."\n'
QUICK = ("rates.body_hz=50",)
NEVER = 'robots.B.position="external"'
ABSENT = Fault(0.0, "capture", "B", "gone", since="launch")
CENTRE, KILLED = ('architecture="centralised"',), Fault(1.0, "kill", "centre")
GO_ON = (NEVER, 'start.missing="go-on"', "start.deadline_s=2")


@dataclass(frozen=True)
class Run:
    """Faults of a run, its exit code, and a part of what it says."""

    code: int
    said: str = ""
    faults: tuple[Fault, ...] = ()
    settings: tuple[str, ...] = ()
    clocks: dict[str, float] = field(default_factory=dict)
    experiment: str = PAIR


def order(at, words, who="B", **more):
    return (Fault(at, "order", who, words, **more),)


def blind(at, lasts):
    return (Fault(at, "body", "B", "nan", lasts),)


def frozen(who, lasts=inf):
    return (Fault(1.0, "pause", who, lasts=lasts),)


ROWS = {
    "undisturbed": Run(0),
    "shortly_held": Run(0, faults=(*order(1.0, "hold"), *order(1.3, "resume"))),
    "killed": Run(1, "s: was lost: its process ended (killed by SIGKILL)", (Fault(1.0, "kill", "B"),)),
    "blind_at_the_end": Run(1, "its own position is lost: none, until the end", (Fault(2.6, "body", "B", "nan"),)),
    "blind_for_a_fifth": Run(1, "B: its position was known for 7", (Fault(1.0, "body", "B", "nan", 0.7),)),
    "shortly_blind": Run(3, "too little is known of B", (Fault(1.0, "body", "B", "nan", 0.3),)),
    "fell": Run(1, "s: land: it came down by itself", (Fault(1.0, "body", "C", "motors"),), experiment=DRONE),
    "landed": Run(1, "B landed after 1.0 of 3 s: ordered to land by an operator", order(1.0, "land")),
    "stopped": Run(1, "B landed after 1.0 of 3 s: ordered to stop by an operator", order(1.0, "stop")),
    "all_landed": Run(1, "landed after 1.0 of 3 s", (*order(1.0, "land"), *order(1.0, "land", "A"))),
    "left_out": Run(1, "before the start: takes no part: it is not ready: no position of its own", (ABSENT,), GO_ON),
    "not_ready": Run(2, "A, B: not ready after 2 s; nothing has moved", (ABSENT,), (NEVER, "start.deadline_s=2")),
    "early_by_seconds": Run(1, "before the common start", order(0.2, "start", "A", since="ready"), experiment=DRONE),
    "early": Run(3, "did not begin together", order(-0.2, "start")),
    "clock_slow": Run(0, clocks={"B": -0.09}),
    "clock_slower": Run(3, "did not begin together", clocks={"B": -0.2}),
    "emergency": Run(1, "emergency stop by operator: zenpark estop", (Fault(1.0, "estop"),)),
    "held": Run(3, "B was held by an operator for 0.7 of 3 s", (*order(1.0, "hold"), *order(1.7, "resume"))),
    "removed": Run(3, "B was removed by an operator at 1.", order(1.0, "remove"), experiment=TRIO),
    "removed_and_ended": Run(
        3, "B was removed by an operator at 1.", (*order(1.0, "remove"), Fault(1.011, "term", "B")), experiment=TRIO
    ),
    "restarted": Run(3, "B was restarted by an operator at 1.", order(1.0, "restart")),
    "replaced": Run(3, "B was replaced by an operator at 1.", order(1.0, "replace --body twin")),
    "interrupted": Run(130, "Interrupted after 1.0 s of 3 s", (Fault(1.0, "interrupt"),)),
    "stopped_while_the_run_was_cut_off": Run(
        1,
        "B landed after 1.0 of 3 s: ordered to stop by an operator",
        (Fault(0.5, "cut", "conductor", lasts=5.0), *order(1.0, "stop")),
    ),
    "held_while_the_run_was_cut_off": Run(
        3,
        "B was held by an operator for 2.0 of 3 s",
        (Fault(0.5, "cut", "conductor", lasts=5.0), *order(1.0, "hold"), Fault(5.0, "slow", "conductor", 1500, 20.0)),
    ),
    "told_too_late_for_the_recorder": Run(  # seed 130855
        1,
        "B at 3.6 s: land: its control loop hangs",
        (
            Fault(2.985, "hang", "B", 0.8),
            Fault(3.2, "cut", "conductor", lasts=0.9),
            Fault(3.9, "slow", "conductor", 3e4, 30.0),
        ),
    ),
    "recorder_killed": Run(1, "the recorder ended (killed by SIGKILL)", (Fault(1.0, "kill", "recorder"),)),
    "recorder_hangs_to_the_end": Run(
        1, "the recording breaks off after", (Fault(1.0, "pause", "recorder", lasts=inf),)
    ),
    "recorder_cut_off": Run(
        1, "A: its position was known for 0% of the time only", (Fault(-0.3, "cut", "recorder", lasts=20.0),)
    ),
    "disk_slow_to_the_end": Run(  # seed 1008094
        1, "the recorder ended (killed by SIGKILL): messages of the end are", (Fault(1.0, "disk", "recorder", 0.6),)
    ),
    "disk_full": Run(1, "cannot be written: No space left", (Fault(1.0, "disk", "recorder", "full"),)),
    "stood_still": Run(2, "this process stood still for more than 3 s", frozen("conductor", 5.0)),
    "router_restarted": Run(
        0, "the router ended (killed by SIGKILL) after 1.0 s, and was", (Fault(1.0, "kill", "router"),)
    ),
    "centre_restarted": Run(
        0,
        "A, B held for up to 0.4 of 3 s: it gets no goals; the centre ended",
        (*frozen("conductor", 0.4), KILLED),
        CENTRE,
    ),
    "stood": Run(3, "A, B stood for up to 1.", (*frozen("conductor", 1.2), KILLED), (*CENTRE, "duration_s=4")),
    "asks_for_its_owner": Run(  # seed 817399
        0,
        "B held for 0.7 of 4 s: no connection to a router, it asked who owns its name.",
        (Fault(0.5, "cut", "B", lasts=1.0), Fault(1.0, "slow", "B", 1000, 0.8)),
        ("duration_s=4",),
    ),
    "criterion_met": Run(0, "Passed: 1 of 1", experiment=PAIR + LIMIT.format(11)),
    "criterion_not_met": Run(1, "Few messages are wanted.", experiment=PAIR + LIMIT.format(9)),
    "unknown_key": Run(2, "durations", settings=("durations=3",)),
}


@pytest.mark.parametrize("name", mostly_slow(ROWS, 4))
def test_exit_code(name):
    run = ROWS[name]
    flight = fly(run.experiment, *run.faults, clocks=run.clocks, settings=[*QUICK, *run.settings])
    assert flight.code == run.code, flight.describe()
    assert run.said in flight.output, flight.output
    assert (flight.crashes, flight.violations) == ([], [])
    unseen = flight.started is None or run.said.startswith(("this process stood", "failed: "))
    assert (flight.metrics is None) == unseen


def test_recorder_that_hangs_is_replaced():
    flight = fly(PAIR, *frozen("recorder"), settings=[*QUICK, "duration_s=7"])
    (killed, _) = flight.of("default-recorder")
    assert 1.0 + 4.4 < killed.ended < 1.0 + 5.1
    assert killed.code == -9
    assert (flight.code, flight.violations) == (1, [])
    assert not [file for file in flight.files if "part2" in file]


def test_recorder_started_after_the_end_leaves_no_part():
    flight = fly(PAIR, Fault(2.2, "pause", "conductor", lasts=2.95))
    first, second = flight.of("default-recorder")
    assert (first.code, second.code) == (0, 0)
    assert first.ended < second.begun
    assert "not joined" not in flight.output
    assert not [file for file in flight.files if "part2" in file]
