"""Condition of a robot by its statuses: one judgement, and one word for it in table, page and conductor."""

import time
from itertools import product

import msgspec
import pytest
from rich.console import Console

from agents.network import messages
from agents.network.keys import Keys
from experiments.real_time.conductor.run_view import RobotView
from experiments.recording.playback import read_whole
from experiments.scene.condition import AT_REST, CONDITIONS, SILENT_S, Condition, condition, robot_row
from experiments.scene.stage import SceneModel
from experiments.view.observer import Observer, RobotReport
from experiments.view.panel import legend, table
from tests.network import Net
from tests.runs import recorded
from tools.live_table import Trends, drawn

HANGS = "its control loop hangs: no tick for 0.5 s"


def status(phase="running", **fields):
    return messages.Status(**{"robot": "CF01", "stamp": 0.0, "phase": phase, "reason": "", **fields})


@pytest.mark.parametrize(
    ("said", "seen", "is_"),
    [
        (status(), {}, Condition.ACTIVE),
        (status(), {"alive": False}, Condition.LOST),
        (status(), {"left": "lost"}, Condition.LOST),
        (status(), {"left": "removed", "alive": False, "silent": True}, Condition.ABSENT),
        (None, {"left": "standby"}, Condition.ABSENT),
        (status(), {"silent": True}, Condition.SILENT),
        (status("landing"), {}, Condition.LANDING),
        (status("done", reason="finished"), {"alive": False, "silent": True}, Condition.DONE),
        (status("done", reason=HANGS), {"alive": False}, Condition.OUT),
        (status("done", reason="finished"), {"touches": True}, Condition.TOUCHING),
        (status(), {"touches": True, "silent": True}, Condition.TOUCHING),
        (status(), {"touches": True, "alive": False}, Condition.LOST),
        (status("done", reason="emergency stop by operator"), {}, Condition.STOPPED),
        (status(hazard="hold: minimum separation: 0.18 m from CF03"), {}, Condition.HELD),
        (status("ready"), {}, Condition.WAITING),
        (None, {}, Condition.WAITING),
    ],
)
def test_condition_of_a_robot(said, seen, is_):
    assert condition(said, **seen) == is_


def test_notes_tell_what_is_wrong():
    for said, note in (
        (status("done", reason="finished"), ""),
        (status("done", reason=HANGS), HANGS),
        (status("idle", reason="no position yet"), "no position yet"),
        (status(missing=["A", "B"], malformed=2, foreign={"A": 3}), "misses A, B; 2 malformed; 3 foreign"),
        (status(hazard="warn: battery low", reason="x", missing=["A"]), "warn: battery low"),
    ):
        assert robot_row("CF01", condition(said), said, None).note == note
    assert robot_row("CF01", Condition.TOUCHING, None, None, touches="touches box").note == "touches box"


def told():
    """Statuses of a recorded run, and what may become of its robots."""
    run = recorded("robotic-park", "duration_s=3.0", "timeline=[]", cases=("event",))
    found = [each for own in read_whole(run.folder / "event.mcap").statuses for each in own]
    fates = (
        ("done", HANGS, ""),
        ("done", "emergency stop", ""),
        ("running", "", "hold: x"),
        ("running", "", ""),
        ("ready", "", ""),
    )
    fates = [dict(zip(("phase", "reason", "hazard"), fate, strict=True)) for fate in fates]
    return found + [msgspec.structs.replace(found[0], **fate) for fate in fates]


def test_table_page_and_conductor_say_the_same():
    words, seen = dict.fromkeys(Condition, ""), set()
    with Net().worn() as net:
        observer = Observer(net.session, Keys())
        for said, age_s, alive in product(told(), (0.1, SILENT_S + 1.0), (True, False)):
            view = RobotView(said, left_because="" if alive or said.phase == "done" else "lost")
            now, heard_at = said.stamp + age_s, time.monotonic() - age_s
            known = view.condition(now)
            observer.robots[said.robot] = RobotReport(status=said, heard_at=heard_at, alive=alive, known=True)
            assert observer.condition(said.robot) == known
            row = Trends().row(said.robot, known, said, 0.0, now=now)
            text = Console(width=140).render_lines(drawn("t", [row], [], 140, 8), pad=False)[2]
            assert "".join(part.text for part in text).split("  ")[1].strip() == row.phase
            page = table([robot_row(said.robot, known, said, 0.0, 0.0)], SceneModel.of_robots(()))
            assert (f">{row.phase}</span>" in page) == (known != Condition.ACTIVE)
            words[known] = row.phase
            seen.add(known)
        observer.robots["new"] = RobotReport()
        assert observer.condition("new") == RobotView().condition(0.0) == Condition.WAITING
        assert robot_row("new", Condition.WAITING, None, None).phase == "starting"
    assert {*Condition} - seen == {Condition.ABSENT, Condition.TOUCHING}
    assert all(words[each] == word for each, (word, _) in CONDITIONS.items() if word and each in seen)
    assert all(f" {CONDITIONS[each][0]}<" in legend() for each in Condition if each >= Condition.LANDING)
    assert not {Condition.HELD, Condition.LOST} & {*AT_REST}
