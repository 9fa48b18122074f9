"""Replay of a run inside its report: a canvas, a script of our own, the positions; no network, no library."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.metrics.signals import Measurement
from experiments.metrics.statistics import first_seed
from experiments.recording.trace import Trace
from experiments.report.page import template
from experiments.scene.models import ROUND, circle
from experiments.scene.stage import FAIR_M, GOOD_M, SceneModel, link_levels, with_bare_links
from twins.arrays import Array

CASES: Final = 2  # side by side
FIRST: Final = 0.6  # share of the run: time of the first picture
STEP_S: Final = 0.1  # pause of two samples
NUMBERS: Final = 300_000  # limit for all samples: 2 MB
QUIET: Final = ("robot", "output", "clock", "router")  # kinds of events that are not on the slider
SCRIPT: Final = Path(__file__).with_name("replay.js")


def embedded(traces: Sequence[Trace]) -> str:
    """The replay as HTML: the first repetition of the first two cases, side by side; empty without a case."""
    first = first_seed(traces)[:CASES]
    if not first:
        return ""
    film = json.dumps(_replay_data(first), separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c")
    return template("replay.html.jinja").render(
        label="Replay of " + ", ".join(trace.case for trace in first),
        good=f"{100 * GOOD_M:g}",
        fair=f"{100 * FAIR_M:g}",
        script=SCRIPT.read_text("utf-8").replace("</", "<\\/").strip(),
        film=film,
    )


def _replay_data(traces: Sequence[Trace]) -> dict[str, Any]:
    stage = SceneModel.of_plan(traces[0].plan)
    scene, end = stage.scene, max(float(trace.time[-1]) for trace in traces)
    width = 4 * len(stage.names) + len(stage.links) + 3 * len(scene.names)
    step = max(STEP_S, end * width * len(traces) / NUMBERS)
    obstacles = []
    for number in range(len(scene.names)):
        outline = scene.outline[number]
        ring = circle(float(scene.radius[number]), ROUND) if outline is None else outline
        obstacles.append({
            "ring": np.round(ring, 3).tolist(), "low": round(float(scene.bottom[number]), 3),
            "high": round(float(stage.tops[number]), 3), "closed": outline is None or bool(scene.closed[number]),
        })  # fmt: skip
    events = {(round(event.stamp, 2), event.text) for trace in traces for event in trace.events
              if event.kind not in QUIET and 0.0 <= event.stamp <= end}  # fmt: skip
    return {
        "names": stage.names,
        "colours": stage.colours.tolist(),
        "radius": stage.radius.round(4).tolist(),
        "high": [kind.height for kind in stage.kinds],
        "links": np.stack([stage.links.sender, stage.links.receiver], axis=1).tolist() if len(stage.links) else [],
        "arena": [np.nan_to_num(edge[:2]).round(3).tolist() for edge in (scene.low, scene.high)],
        "obstacles": obstacles,
        "begin": 0.0,
        "end": end,
        "at": round(FIRST * end, 2),
        "events": sorted(events),
        "cases": [_case(trace, step) for trace in traces],
    }


def _case(trace: Trace, step: float) -> dict[str, Any]:
    """Samples of one case: x, y, z and yaw of each robot [mm, mrad], the level of each link's error, the obstacles."""
    stage = SceneModel.of_plan(trace.plan)
    grid = np.arange(0.0, float(trace.time[-1]) + 1e-9, step)
    at = np.clip(np.searchsorted(trace.time, grid - 1e-9), 0, len(trace.time) - 1)
    place = trace.true_position[at]
    rows = np.concatenate([place, np.nan_to_num(trace.yaw[at])[..., None]], axis=2)
    level = link_levels(with_bare_links(trace.plan, grid, place, Measurement.of(trace).errors.error[at]))
    poses = np.stack([stage.scene.at(float(t)) for t in grid]).reshape(len(grid), -1)
    return {
        "name": trace.case,
        "begin": 0.0,
        "step": step,
        "p": [_thousandths(row.ravel()) for row in rows],
        "e": level.tolist(),
        "o": [_thousandths(row) for row in poses],
    }


def _thousandths(values: Array) -> list[int | None]:
    """Thousandths; None for what is unknown."""
    return [None if np.isnan(value) else round(1e3 * value) for value in values.tolist()]
