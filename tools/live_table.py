"""Live table of the robots of a run, cut to the terminal: for the run's own process and for `./zenpark top`.

Rows that need attention come first; where rows do not fit, a line of totals stands for all of them. Columns drop from
the right, names are never cut. Notes that do not fit their column follow whole, in the place of events.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from math import inf
from textwrap import wrap
from typing import TYPE_CHECKING, Final

from agents.network.messages import Event, Status
from experiments.scene.condition import Condition, RobotRow, robot_row
from tools.terminal import printable

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

WINDOW_S: Final = 0.9  # shortest time over which CPU and growth are measured
RECENT_S: Final = 5.0  # a counter that grew within this time is coloured
LOW_BATTERY: Final = 0.25
FLAT_BATTERY: Final = 0.1
EVENTS: Final = 5  # number of the last ones below the table
GAP: Final = 2  # space between columns [characters]
NOTE: Final = 10  # least width of the last column
BAR: Final = 20


COLOURS: Final = {
    Condition.LOST: "bold red", Condition.STOPPED: "bold red", Condition.TOUCHING: "bold red",
    Condition.OUT: "yellow", Condition.SILENT: "magenta", Condition.HELD: "yellow",
}  # fmt: skip


@dataclass
class _Counters:
    """Counters of a robot at an earlier status, and what came of them."""

    status: Status
    cpu: float | None = None
    rate: float = 0.0  # [Hz] rate of transmitted poses
    grew: dict[str, float] = field(default_factory=dict)  # [s, UTC] last growth, by counter


class Trends:
    """Differences of statuses: share of a core, rate of poses, and counters that grow."""

    def __init__(self) -> None:
        self._known: dict[str, _Counters] = {}

    def add(self, status: Status) -> _Counters:
        """Takes in the last status of a robot; repeated ones change nothing."""
        known = self._known.get(status.robot)
        if known is None or known.status.pid != status.pid:
            known = self._known[status.robot] = _Counters(status)
        span_s = status.stamp - known.status.stamp
        if span_s >= WINDOW_S:
            before = known.status
            known.cpu = max(0.0, status.cpu_s - before.cpu_s) / span_s
            known.rate = max(0, status.sent - before.sent) / span_s
            for word, now, then in (
                ("late", status.missed, before.missed),
                ("lost", sum(status.lost.values()), sum(before.lost.values())),
            ):
                if now > then:
                    known.grew[word] = status.stamp
            known.status = status
        return known

    def row(
        self, name: str, condition: Condition, status: Status | None, error: float | None, *, now: float,
        left: str = "", touches: str = "",
    ) -> RobotRow:  # fmt: skip
        """The row of a robot as `robot_row` makes it, at `now` [s, UTC] by the clock of the statuses' stamps."""
        row = robot_row(name, condition, status, error, left=left, touches=touches)
        if status is None:
            return row
        trend = self.add(status)
        growing = frozenset(word for word, when in trend.grew.items() if now - when < RECENT_S)
        return replace(row, rate=trend.rate, cpu=trend.cpu, growing=growing)


def needs(row: RobotRow) -> tuple[int, ...]:
    """Needs of a robot, the gravest first; the larger, the more urgent, and zeros without any."""
    low = row.battery is not None and row.battery < LOW_BATTERY
    if row.condition == Condition.ABSENT:
        return (0,) * 5
    grave = row.condition if row.condition >= Condition.HELD else 0
    return int(grave), int(row.warned), int(low), int("late" in row.growing), int("lost" in row.growing)


def worst_first(rows: Sequence[RobotRow], *, fit: bool) -> list[RobotRow]:
    """Rows by urgency; rows of one urgency by error where not all fit, else as they came: a table that stays still."""
    return sorted(
        rows, key=lambda row: (needs(row), 0.0 if fit else -inf if row.error is None else row.error), reverse=True
    )


def totals(rows: Sequence[RobotRow], shown: int) -> RobotRow:
    """One row for all: the largest error, the lowest battery, sums of the rest, each process counted once."""
    cpu = {row.pid or row.name: row.cpu for row in rows if row.cpu is not None}
    notable = sum(any(needs(row)) for row in rows)
    return RobotRow(
        f"all {len(rows)}",
        Condition.ACTIVE,
        f"+{len(rows) - shown} more",
        error=max((row.error for row in rows if row.error is not None), default=None),
        rate=sum(row.rate or 0.0 for row in rows),
        late=sum(row.late or 0 for row in rows),
        lost=sum(row.lost or 0 for row in rows),
        cpu=sum(cpu.values()) if cpu else None,
        battery=min((row.battery for row in rows if row.battery is not None), default=None),
        sent=sum(row.sent or 0 for row in rows),
        note=f"{notable} need{'s' * (notable == 1)} attention" if notable else "largest error, lowest battery",
        growing=frozenset().union(*(row.growing for row in rows)),
    )


HEADS: Final = ("robot", "phase", "error, m", "f, Hz", "late", "lost", "CPU", "battery", "sent", "")
LEFT: Final = (0, 1, len(HEADS) - 1)  # columns that begin at the left


def metres(error: float | None) -> str:
    """An error [m] in words; a dash of robots that have no link, or no goal of their own."""
    return "–" if error is None else f"{error:.3f}"


def _cells(row: RobotRow) -> list[Text]:
    """Texts of a row, by column."""
    from rich.text import Text

    colour = COLOURS.get(row.condition, "yellow" if needs(row)[1] else "")
    counts = [("", "") if value is None else (str(value), "yellow" if word in row.growing else "")
              for word, value in (("late", row.late), ("lost", row.lost))]  # fmt: skip
    charge = ""
    if row.battery is not None and row.battery < LOW_BATTERY:
        charge = "bold red" if row.battery < FLAT_BATTERY else "yellow"
    cells = (
        (printable(row.name), colour),
        (printable(row.phase), colour),
        (metres(row.error), ""),
        (f"{row.rate or 0.0:.1f}", ""),
        *counts,
        ("" if row.cpu is None else f"{100 * row.cpu:.0f} %", ""),
        ("" if row.battery is None else f"{100 * row.battery:.0f} %", charge),
        ("" if row.sent is None else str(row.sent), "dim"),
        (printable(row.note), colour),
    )
    return [Text(text, style) for text, style in cells]


def drawn(title: str, rows: Sequence[RobotRow], events: Sequence[Event], width: int, height: int) -> Group:
    """Table of robots, in the order of the experiment, with a title, cut notes, and as many last events as have room.

    `width` [characters] and `height` [lines] are limits of all of it.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    below = min(EVENTS, len(events), max(0, height // 4 - 1))
    room = max(1, height - 2 - below)
    fit = len(rows) <= room
    chosen = worst_first(rows, fit=fit)[: room if fit else max(1, room - 1)]
    if not fit:
        chosen.append(totals(rows, len(chosen)))
    cells = [_cells(row) for row in chosen]
    widths = [max(map(len, (HEADS[k], *(line[k].plain for line in cells)))) for k in range(len(HEADS) - 1)]
    ends = [*accumulate(widths, lambda end, wide: end + GAP + wide), 0]
    kept = max(1, sum(0 < end <= width for end in ends))
    noted = kept == len(widths) and width - ends[kept - 1] - GAP >= NOTE
    table = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, header_style="bold", expand=noted)
    for k, head in enumerate(HEADS[: kept + noted]):
        table.add_column(
            head, justify="left" if k in LEFT else "right", no_wrap=True, ratio=int(k == len(widths)) or None
        )
    for line in cells:
        table.add_row(*line[: kept + noted])
    space = width - ends[kept - 1] - GAP if noted else 0
    spare = max(0, height - 2 - len(chosen))
    whole = [
        line
        for row in chosen
        if len(row.note) > space
        for line in wrap(printable(f"{row.name}: {row.note}"), width, initial_indent="  ", subsequent_indent="    ")
    ][:spare]
    below = min(below, spare - len(whole))
    said = [printable(f"  {event.kind} {event.source}: {event.text}") for event in [*events][len(events) - below :]]
    return Group(
        Text(printable(title)[:width], style="bold"), table, *map(Text, whole),
        *(Text(each[:width], style="dim") for each in said),
    )  # fmt: skip


def heading(what: str, elapsed: float | None, duration: float | None, name: str = "") -> str:
    """Title: what goes on, the time since the common start, a bar of it where the end is known [s], and the run."""
    if elapsed is not None and duration:
        done = round(BAR * min(1.0, max(0.0, elapsed / duration)))
        what += f"  {elapsed:5.1f} / {duration:g} s  " + "━" * done + "─" * (BAR - done)
    elif elapsed is not None:
        what += f"  {elapsed:.1f} s"
    return f"{what}  {name}".rstrip()


def common_phase(phases: Sequence[str]) -> str:
    """Phases of the robots in words, the most frequent first: `running 6, landing 1`."""
    found = Counter(phases).most_common()
    return found[0][0] if len(found) == 1 else ", ".join(f"{phase} {count}" for phase, count in found) or "no robot"
