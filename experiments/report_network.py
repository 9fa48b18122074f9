"""What the modelled network did to poses: the tables of a report, and its sentences in the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from experiments.measured import CaseMetrics, Passage
from experiments.report_tables import Row, Table, number
from experiments.seeds import by_case

PROSE: Final = (
    "What the file asks of the network, on top of what a real one does: poses that it dropped did come, and were not "
    "heard. Delays are from when a pose was taken until it was heard, whatever caused them."
)


def sentences(cases: Sequence[CaseMetrics]) -> list[str]:
    """One for each case with a modelled network: what it dropped, and how long the rest took."""
    found = []
    for name, runs in _modelled(cases).items():
        each = [link for run in runs for link in run.passages]
        heard, dropped = _counts(each)
        where = f" in {name}" if len(by_case(cases)) > 1 else ""
        text = f"The modelled network dropped {number(dropped)} of {number(heard + dropped)} samples{where}"
        text += f" ({_share(heard, dropped)} %)" if dropped else ""
        mean, longest = _delay(each)
        if mean is not None:
            text += f"; those heard took {number(mean, 1e3)} ms, at most {number(longest, 1e3)} ms"
        found.append(f"{text}.")
    return found


def network_tables(cases: Sequence[CaseMetrics]) -> tuple[Table, ...]:
    """For each case with a modelled network, what became of the poses on each link; several seeds are added up."""
    tables = []
    for name, runs in _modelled(cases).items():
        rows = []
        for k, link in enumerate(runs[0].passages):
            rows.append(Row((f"{link.speaker} > {link.listener}", *_cells([run.passages[k] for run in runs]))))
        rows.append(Row(("all", *_cells([link for run in runs for link in run.passages])), sum=True))
        head = ("Link", "Heard", "Dropped", "Share [%]", "Mean delay [ms]", "Longest [ms]")
        tables.append(Table(head, tuple(rows), title=name))
    return tuple(tables)


def _modelled(cases: Sequence[CaseMetrics]) -> dict[str, list[CaseMetrics]]:
    return {name: list(runs) for name, runs in by_case(cases).items() if runs[0].modelled}


def _cells(each: Sequence[Passage]) -> tuple[str, ...]:
    heard, dropped = _counts(each)
    mean, longest = _delay(each)
    return number(heard), number(dropped), _share(heard, dropped), number(mean, 1e3), number(longest, 1e3)


def _counts(each: Sequence[Passage]) -> tuple[int, int]:
    return sum(link.heard for link in each), sum(link.dropped for link in each)


def _share(heard: int, dropped: int) -> str:
    return number(100.0 * dropped / (heard + dropped) if heard + dropped else None)


def _delay(each: Sequence[Passage]) -> tuple[float | None, float | None]:
    """Mean and largest delay [s] over all poses heard on some links; None if there are none."""
    heard = sum(link.heard for link in each)
    if not heard:
        return None, None
    total = sum(link.heard * link.delay_mean for link in each if link.delay_mean is not None)
    return total / heard, max(link.delay_max for link in each if link.delay_max is not None)
