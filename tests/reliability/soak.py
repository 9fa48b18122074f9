"""`./zenpark test --soak`: an experiment for hours, and whether anything grows, is lost, slows down or dies.

Everything is written down as it comes: the processes that are measured keep no samples.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Final, NamedTuple

import typer

from agents.errors import ExplainedError
from agents.runtime.command_line import interrupts
from experiments.file.document import chosen, load
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.conductor.run_view import RunFailed
from experiments.recording.run_folder import new_folder
from experiments.report.page import NONE, Mark, VerdictLine
from tests.reliability.soak_sampler import Sampler, Soaked, SoakSample
from tools.options import AsJson, Bodies, Case, Out, Settings, print_result
from tools.progress import columns

WARM_SHARE: Final = 0.5  # of the run that does not count (a recorder fills its pools for 150 s), but not more than
WARM_S: Final = 300.0
WINDOW: Final = 0.1  # share of what counts that is compared at both ends
GROWTH: Final = 0.02  # of the memory
JUDGED_S: Final = 300.0  # memory of a shorter run says nothing: allocators are still filling their pools
SLOWER: Final = 2.0  # times the delay at the beginning
DELAY_S: Final = 0.005  # delays below are the noise of the machine
MISSED: Final = 0.01  # share of the ticks


def soak(
    file: Annotated[str, typer.Argument(metavar="[FILE]", help="Experiment file.")] = "endurance",
    *,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440.0, help="How long.")] = 60.0,
    case: Case = None,
    out: Out = None,
    settings: Settings = None,
    bodies: Bodies = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    read = load(file, *(settings or []), f"duration_s={60.0 * minutes!r}")
    name = case or next(iter(read.cases()))
    folder = new_folder(read, out)
    sampler = Sampler(chosen(read, [name])[name], folder)
    with interrupts() as interrupted:
        user = Supervision(sampler, interrupted)
        try:
            ended = conduct(read, folder, RunOptions([name], bodies, here=True), user)
            if ended.failures and not interrupted():
                sampler.end_early(RunFailed("; ".join(ended.failures)))
        except ExplainedError as error:
            sampler.end_early(error)
        soaked = sampler.result(interrupted=interrupted() or bool(user.emergency))
    findings = judge(soaked)
    failed = any(finding.mark == "bad" for finding in findings)
    shown = {"run": folder, "passed": not failed, "findings": findings}
    print_result(shown, *columns(table(soaked)), *map(str, findings), f"results: {folder}", as_json=as_json)
    return 130 if soaked.interrupted else int(failed)


class Ends(NamedTuple):
    """Rows of a process after the warm-up: first and last window."""

    first: Sequence[SoakSample]
    last: Sequence[SoakSample]

    def over(self, what: Callable[[Iterable[float]], float], field: str) -> tuple[float, float]:
        """A statistic of a field in both windows."""
        first, last = (what(getattr(row, field) for row in rows) for rows in self)
        return first, last

    @property
    def growth(self) -> float:
        """Growth of the memory, as a share of the first."""
        first, last = self.over(statistics.median, "rss_mb")
        return last / first - 1.0 if first else 0.0


def warm_s(soaked: Soaked) -> float:
    """From then on it counts [s]."""
    return min(WARM_SHARE * soaked.duration_s, WARM_S)


def ends(soaked: Soaked) -> dict[str, Ends]:
    """Both ends of each process that has enough rows to have them, by name."""
    found = {}
    for process in sorted({row.process for row in soaked.rows}):
        counted = [row for row in soaked.rows if row.process == process and row.time_s >= warm_s(soaked)]
        size = max(2, round(WINDOW * len(counted)))
        if len(counted) >= 2 * size:
            found[process] = Ends(counted[:size], counted[-size:])
    return found


def judge(soaked: Soaked) -> list[VerdictLine]:
    """The verdict; bad findings fail it."""
    both, last = ends(soaked), {row.process: row for row in soaked.rows}
    found = [*_alive(soaked), _memory(soaked, both)]

    def add(wrong: str, right: str, mark: Mark = "bad") -> None:
        found.append(VerdictLine(mark, wrong) if wrong else VerdictLine("good", right))

    def total(field: str) -> int:
        return sum(getattr(row, field) or 0 for row in last.values())

    for what, field in (("threads", "threads"), ("file descriptors", "files")):
        counts = {process: each.over(max, field) for process, each in both.items()}
        grown = ", ".join(f"{process} +{after - first}" for process, (first, after) in counts.items() if after > first)
        add(grown and f"{what} grow: {grown}", f"{what} do not grow")
    lost = ", ".join(f"{process} {row.lost}" for process, row in last.items() if row.lost)
    received = sum(row.received or 0 for row in soaked.rows)
    untested = "" if received else "no pose was received: nothing was tested"
    add(f"lost poses: {lost}" if lost else untested, f"0 of {received} poses were lost")
    malformed = total("malformed")
    add(f"{malformed} payloads were refused as malformed" if malformed else "", "no payload was refused")
    windows = [
        [row.delay_s for each in both.values() for row in each[end] if row.delay_s is not None] for end in (0, 1)
    ]
    if all(windows):
        before, after = map(statistics.median, windows)
        longest = max(row.longest_s or 0.0 for row in soaked.rows)
        text = (
            f"delay of poses: {1e3 * before:.2f} ms at first, {1e3 * after:.2f} ms at last, {1e3 * longest:.0f} at most"
        )
        add(text if after > max(SLOWER * before, DELAY_S) else "", text)
    if ticks := total("ticks"):
        share = total("missed") / ticks
        text = f"{total('missed')} of {ticks} ticks were missed ({100.0 * share:.3f} %)"
        add(text if share >= MISSED else "", text, "fair")
    return found


def _alive(soaked: Soaked) -> list[VerdictLine]:
    lasted, sampled = max((row.time_s for row in soaked.rows), default=0.0), {row.process for row in soaked.rows}
    bad = [f"{name} {what}" for name, what in soaked.failed.items()]
    bad += [f"{name} never had a process" for name in soaked.robots if name not in sampled | soaked.failed.keys()]
    if soaked.interrupted:
        bad.append(f"it was interrupted after {lasted:.0f} s of {soaked.duration_s:g} s")
    good = f"all {len(soaked.robots)} robots lived through {lasted / 60.0:.1f} minutes"
    return [VerdictLine("bad", text) for text in bad] or [VerdictLine("good", good)]


def _memory(soaked: Soaked, both: Mapping[str, Ends]) -> VerdictLine:
    if not both:
        return VerdictLine("bad", "too few samples to compare beginning and end: let it run longer")
    grown = {process: each.growth for process, each in both.items()}
    most = max(grown, key=lambda process: grown[process])
    text = f"memory: largest growth after {warm_s(soaked):.0f} s is {100 * grown[most]:+.2f} % ({most})"
    if soaked.duration_s < JUDGED_S:
        return VerdictLine("plain", f"{text}; not judged below {JUDGED_S / 60:.0f} minutes")
    return VerdictLine("bad" if grown[most] > GROWTH else "good", f"{text}, limit {100 * GROWTH:g} %")


def table(soaked: Soaked) -> list[tuple[str, ...]]:
    """A head and a row for each process: resident memory after the warm-up and at the end, CPU as share of a core."""
    head = ("process", "MB first", "MB last", "growth", "threads", "files", "CPU", "lost", "missed", "delay [ms]")
    rows: list[tuple[str, ...]] = [head]
    for process, each in ends(soaked).items():
        last, first = each.last[-1], each.first[0]
        share = 100.0 * (last.cpu_s - first.cpu_s) / max(last.time_s - first.time_s, 1e-9)
        delays = [row.delay_s for row in soaked.rows if row.process == process and row.delay_s is not None]
        memory = (f"{size:.1f}" for size in each.over(statistics.median, "rss_mb"))
        counts = (NONE if count is None else str(count) for count in (last.lost, last.missed))
        delay = f"{1e3 * statistics.median(delays):.2f}" if delays else NONE
        sizes = f"{100 * each.growth:+.2f} %", str(last.threads), str(last.files), f"{share:.1f} %"
        rows.append((process, *memory, *sizes, *counts, delay))
    return rows
