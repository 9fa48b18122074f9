"""The live table: what fits a terminal, in which order, and in which colour."""

import msgspec
import pytest
from rich.console import Console

from agents.network.messages import Event, Status
from experiments.real_time.conductor.run_view import RobotView
from experiments.scene.condition import Condition, RobotRow, condition
from tools.live_table import HEADS, Trends, drawn, heading, needs, worst_first

STATUS = Status(
    "robot-01", 10.0, "running", "", "", 0.9, 100, 300, {"robot-02": 0}, {}, 0, 0, 500, 0, 500, 0, 0, 0.0, 1.0, [],
    7, 2.0, 50.0,
)  # fmt: skip
EVENTS = [Event(float(k), "hazard", "robot-01", f"number {k} " + "far " * 40) for k in range(9)]


def rows(count):
    return [
        RobotRow(f"robot-{k:02}", Condition.ACTIVE, "running", error=0.001 * k, rate=12.5, late=0, lost=3, cpu=0.04,
            battery=0.8, sent=900, pid=k + 1)
        for k in range(count)
    ]  # fmt: skip


def segments(title, rows, events, width, height):
    return Console(width=width, height=height).render_lines(drawn(title, rows, events, width, height), pad=False)


def lines(title, rows, events, width, height):
    return ["".join(part.text for part in line).rstrip() for line in segments(title, rows, events, width, height)]


def styles(*rows):
    return {part.text.strip(): str(part.style) for line in segments("t", [*rows], [], 140, 10) for part in line}


@pytest.mark.parametrize("width", [40, 64, 80, 140])
@pytest.mark.parametrize("height", [8, 14, 24, 50])
@pytest.mark.parametrize("count", [3, 12, 100])
def test_table_fits_the_terminal_with_whole_names(width, height, count):
    held = msgspec.structs.replace(STATUS, hazard="hold: minimum separation: 0.18 m from robot-03 (limit 0.25 m)")
    all_rows = rows(count)
    all_rows[-1] = Trends().row(f"robot-{count - 1:02}", Condition.HELD, held, 0.0, now=10.1)
    text = lines(heading("event: formation", 5.3, 15.0), all_rows, EVENTS, width, height)
    assert max(map(len, text)) <= width
    assert len(text) <= height
    assert text[0].startswith("event: formation")
    columns = text[1].split("  ")
    heads = [word.strip() for word in columns if word.strip()]
    assert heads == [head for head in HEADS if head][: len(heads)], "columns drop from the right"
    named = [line.split()[0] for line in text[2:] if line.startswith("robot-")]
    assert named[0] == f"robot-{count - 1:02}", "what needs attention comes first"
    assert all(len(name) == len("robot-00") for name in named)
    total = [line for line in text if line.startswith(f"all {count}")]
    assert bool(total) == (len(named) < count)
    if total:
        assert f"+{count - len(named)} more" in total[0]


def test_reason_is_whole_at_eighty_columns():
    reason = "its control loop hangs: no tick for 0.5 s, and it has landed by itself since then, as its watchdog says"
    done = msgspec.structs.replace(STATUS, phase="done", reason=reason)
    all_rows = [*rows(5), Trends().row("robot-05", condition(done), done, 0.0, now=10.1)]
    text = " ".join(line.strip() for line in lines("t", all_rows, EVENTS, 80, 24))
    assert f"robot-05: {reason}" in text
    assert text.count("number") == 5


def test_a_wide_table_has_all_columns_and_totals():
    text = lines("t", rows(100), [], 140, 20)
    assert all(head in text[1] for head in HEADS)
    assert text[-1].split()[:2] == ["all", "100"]
    for figure in ("0.099", "1250.0", "300", "400 %", "80 %", "90000"):
        assert figure in text[-1]
    assert text[2].startswith("robot-99"), "where rows do not fit, the largest error comes first"
    assert lines("realm park", [], EVENTS, 80, 24)[:2] == ["realm park", "  ".join(HEADS).rstrip()]
    text = lines(
        "t",
        [RobotRow("a\x1b[2J", Condition.ACTIVE, "x\ny", note="\x1b]0;z\x07")],
        [Event(0.0, "k", "s", "\x1b[31m")],
        100,
        20,
    )
    assert all(line.isprintable() for line in text)


def test_rows_that_fit_stay_in_their_order():
    few = rows(5)
    assert worst_first(few, fit=True) == few
    few[3] = RobotRow("robot-03", Condition.LOST, "lost")
    assert [row.name for row in worst_first(few, fit=True)][:2] == ["robot-03", "robot-00"]


def test_cpu_is_a_share_and_growing_counters_coloured():
    trends = Trends()
    first = trends.row("robot-01", Condition.ACTIVE, STATUS, None, now=10.0)
    assert (first.cpu, first.growing) == (None, frozenset())
    later = msgspec.structs.replace(STATUS, stamp=12.0, cpu_s=2.1, missed=2, lost={"robot-02": 5}, battery=0.2)
    later = msgspec.structs.replace(later, sent=STATUS.sent + 6)
    row = trends.row("robot-01", Condition.ACTIVE, later, 0.01, now=12.0)
    assert (row.cpu, row.rate) == (pytest.approx(0.05), 3.0)
    assert row.growing == {"late", "lost"}
    assert needs(row) == (0, 0, 1, 1, 1)
    seen = styles(row)
    assert seen["2"] == seen["5"] == seen["20 %"] == "yellow"
    flat = trends.row("robot-01", Condition.ACTIVE, msgspec.structs.replace(later, battery=0.05), 0.01, now=12.0)
    held = trends.row("held-one", Condition.HELD, msgspec.structs.replace(later, hazard="hold: x"), 0.01, now=12.0)
    seen = styles(flat, held)
    assert (seen["5 %"], seen["held-one"]) == ("bold red", "yellow")
    repeated = msgspec.structs.replace(later, stamp=20.0)
    calm = trends.row("robot-01", Condition.ACTIVE, repeated, 0.01, now=20.0)
    assert (calm.growing, calm.cpu) == (frozenset(), 0.0)
    restarted = msgspec.structs.replace(later, stamp=21.0, pid=8, cpu_s=0.1)
    assert trends.row("robot-01", Condition.ACTIVE, restarted, None, now=21.0).cpu is None


def test_what_a_robot_needs():
    for hazard, now, left, urgent, phase in (
        ("", 10.5, "", 0, "running"),
        ("", 20.0, "", Condition.SILENT, "silent"),
        ("hold: link silence", 10.5, "", Condition.HELD, "held"),
        ("", 10.5, "lost", Condition.LOST, "lost"),
        ("", 20.0, "removed", 0, "removed"),
    ):
        view = RobotView(msgspec.structs.replace(STATUS, hazard=hazard), left_because=left)
        row = Trends().row("robot-01", view.condition(now), view.status, None, now=now, left=left)
        assert (needs(row)[0], row.phase) == (urgent, phase)
