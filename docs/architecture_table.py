"""The table of architectures.md: who decides, on networks of different delay, in virtual time.

python docs/architecture_table.py               seeds 1 to 20
python docs/architecture_table.py --seeds 5     fewer, for a quick look
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from statistics import fmean
from typing import Any, Final

import numpy as np

from experiments.definition.experiment import ChannelTable
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.sweep.runs import RunMetrics, run_metrics
from experiments.virtual_time import simulation
from experiments.virtual_time.log import RunRecorder

SEEDS: Final = 20
DELAYS_S: Final = (0.0, 0.02, 0.05, 0.1)
TRIGGERS: Final[dict[str, dict[str, Any]]] = {
    "periodic, 50 Hz": {"kind": "periodic", "period_s": 0.02},
    "send-on-delta, 1 cm": {"kind": "send-on-delta", "threshold": 0.01},
}


def flown(plan: Plan, seeds: Sequence[int]) -> tuple[list[RunMetrics], float, float, float]:
    """Metrics of each seed; of a run, on average: messages of the network, deliveries, and the delay of goals [s]."""
    receivers = np.bincount(plan.pose_links.sender, minlength=len(plan.names))
    found: list[RunMetrics] = []
    messages, deliveries, delay = [], [], []
    for seed in seeds:
        log = simulation.simulate(plan, seed, lean=True)
        book, time = RunRecorder(log, plan, ""), log.sent.stamp
        found.append(run_metrics(book.trace()))
        within = (time >= -1e-9) & (time < plan.experiment.duration_s - 1e-9)
        sent = np.bincount(log.sent.link[within], minlength=len(log.names))
        told, received = 0, 0
        if (seen := book.goals) is not None:
            told, received = len(seen.sent), int(seen.received.sum())
            delay.append(float(seen.delay.mean()))
        messages.append(int(sent.sum()) + told)
        deliveries.append(int(sent @ receivers) + received + told)
    return found, fmean(messages), fmean(deliveries), fmean(delay) if delay else 0.0


def mean(runs: Sequence[RunMetrics], what: str) -> float:
    """Over the seeds for which it is known."""
    known = [value for run in runs if (value := run.values[what]) is not None]
    return fmean(known) if known else float("nan")


def main() -> None:
    """Prints a table for each trigger."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=SEEDS)
    seeds = tuple(range(1, parser.parse_args().seeds + 1))
    cases = load("architectures").cases()
    for name, trigger in TRIGGERS.items():
        print(f"\n{name}, seeds 1 to {len(seeds)}\n")
        print("| one way | decides | messages | deliveries | goals late by | IAE | ITAE | acquired | formed |")
        print("|---|---|---|---|---|---|---|---|---|")
        first: list[RunMetrics] | None = None
        for delay_s in DELAYS_S:
            for who, case in cases.items():
                plan = case.changed(trigger=trigger, channel=ChannelTable(delay_s=delay_s))
                runs, messages, deliveries, late = flown(plan, seeds)
                first = first or runs
                ratio = {what: mean(runs, what) / mean(first, what) for what in ("iae", "itae")}
                formed = sum(run.values["acquired_s"] is not None for run in runs)
                late_ms = "–" if who == "distributed" else f"{1e3 * late:.0f} ms"
                print(
                    f"| {1e3 * delay_s:g} ms | {who} | {messages:.0f} | {deliveries:.0f} | {late_ms} | "
                    f"{ratio['iae']:.3f} | {ratio['itae']:.3f} | {mean(runs, 'acquired_s'):.1f} s | "
                    f"{formed}/{len(runs)} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
