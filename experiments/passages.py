"""What became of poses on each link: how many were heard, how many the modelled network dropped, and how long."""

from __future__ import annotations

import numpy as np

from experiments import assign
from experiments.measured import Passage
from experiments.trace import Trace


def passages(trace: Trace) -> tuple[Passage, ...]:
    """Of every link on which something may be heard, those that only avoidance needs included."""
    links, rows = assign.heard_links(trace.experiment), len(trace.robots)
    count = len(links)
    dropped = np.zeros(count, dtype=np.intp) if trace.dropped is None else trace.dropped
    ends = links.listener * rows + links.speaker
    order = np.argsort(ends)
    asked = trace.heard.listener * rows + trace.heard.speaker
    at = np.searchsorted(ends, asked, sorter=order)
    known = at < count
    known[known] = ends[order[at[known]]] == asked[known]
    link, took = order[at[known]], (trace.heard.time - trace.heard.stamp)[known]
    heard = np.bincount(link, minlength=count)
    total = np.bincount(link, weights=took, minlength=count)
    longest = np.full(count, -np.inf)
    np.maximum.at(longest, link, took)
    columns = zip(links.listener.tolist(), links.speaker.tolist(), heard.tolist(), dropped.tolist(), strict=True)
    return tuple(
        Passage(
            listener=trace.robots[i],
            speaker=trace.robots[j],
            heard=number,
            dropped=gone,
            delay_mean=float(total[k]) / number if number else None,
            delay_max=float(longest[k]) if number else None,
        )
        for k, (i, j, number, gone) in enumerate(columns)
    )
