"""Layouts that ship for other viewers: what they name is in a recording."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from mcap.reader import make_reader

from experiments.file.document import load
from experiments.run import simulate
from tests.commands import ROOT
from tests.system.lab import typed

LAYOUT = ROOT / "docs" / "viewers" / "foxglove.json"


def panels(part: Any) -> Iterator[str]:
    """Panels of a layout, or of a part of it: a panel, or two parts beside each other."""
    if isinstance(part, str):
        yield part
    else:
        for side in ("first", "second"):
            yield from panels(part[side])


@pytest.mark.slow
def test_foxglove_layout_names_what_a_recording_has(tmp_path):
    simulate(load("triangle", "duration_s=1.0", "timeline=[]"), cases=["event"], folder=tmp_path)
    file = tmp_path / "event.mcap"
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    recorded = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
    moves = [moved for each in typed(file, "/tf") for moved in each.transforms]
    frames = {name for moved in moves for name in (moved.header.frame_id, moved.child_frame_id)}
    layout = json.loads(LAYOUT.read_text("utf-8"))
    configured = layout["configById"]
    shown = list(panels(layout["layout"]))
    assert sorted(shown) == sorted(configured)
    assert {panel.partition("!")[0] for panel in shown} == {"3D", "RawMessages"}
    scene, events = configured["3D!zenpark"], configured["RawMessages!zenpark"]
    assert {name: recorded[name] for name in scene["topics"]} == {"/scene": "visualization_msgs/msg/MarkerArray"}
    assert all(topic["visible"] for topic in scene["topics"].values())
    assert recorded[events["topicPath"]] == "zenpark_msgs/msg/Event"
    assert {scene["followTf"], *(layer["frameId"] for layer in scene["layers"].values())} <= frames
    assert {"map", "KH01", "KH02", "CF01"} <= frames
    markers = [marker for each in typed(file, "/scene") for marker in each.markers]
    assert {marker.header.frame_id for marker in markers} <= frames
