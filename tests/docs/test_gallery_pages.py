"""Pictures of the gallery, drawn by a program that runs, and layouts of Foxglove and RViz that docs name."""

import json
import runpy

import pytest
import yaml
from mcap.reader import make_reader

from experiments.catalogue import index
from tests.commands import ROOT
from tests.system.lab import typed
from zenpark import load, simulate

FOLDER = ROOT / "docs" / "gallery"
DRAW = runpy.run_path(str(FOLDER / "draw.py"))
LAYOUT = ROOT / "docs" / "viewers" / "foxglove.json"
RVIZ = ROOT / "docs" / "viewers" / "zenpark.rviz"
LAWS = {page.stem for page in FOLDER.glob("*.md")} - {"index"}


def test_every_page_has_a_light_picture():
    assert {*DRAW["SUBJECTS"]} == LAWS
    assert all(index.find_file(name).is_file() for name in LAWS)
    sizes = {name: (FOLDER / f"{name}.svg").stat().st_size for name in LAWS}
    assert {name: size for name, size in sizes.items() if size > 60_000} == {}
    first = (FOLDER / "index.md").read_text("utf-8")
    assert [name for name in LAWS if f"({name}.md)" not in first] == []


def test_figures_of_a_recorded_run_are_printed(tmp_path, capsys):
    simulate(load("consensus", "duration_s=2.0"), cases=["event"], folder=tmp_path)
    DRAW["main"](["--runs", str(tmp_path)])
    assert capsys.readouterr().out.startswith("consensus event: 1.")


@pytest.mark.slow
def test_layouts_name_what_a_recording_has(tmp_path):
    simulate(load("triangle", "duration_s=1.0", "timeline=[]"), cases=["event"], folder=tmp_path)
    file = tmp_path / "event.mcap"
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    recorded = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
    moves = [moved for each in typed(file, "/tf") for moved in each.transforms]
    frames = {name for moved in moves for name in (moved.header.frame_id, moved.child_frame_id)}
    configured = json.loads(LAYOUT.read_text("utf-8"))["configById"]
    scene, events = configured["3D!zenpark"], configured["RawMessages!zenpark"]
    assert {name: recorded[name] for name in scene["topics"]} == {"/scene": "visualization_msgs/msg/MarkerArray"}
    assert recorded[events["topicPath"]] == "zenpark_msgs/msg/Event"
    assert {"map", scene["followTf"], *(layer["frameId"] for layer in scene["layers"].values())} <= frames
    rviz = yaml.safe_load(RVIZ.read_text("utf-8"))["Visualization Manager"]
    shown = {each["Class"].rpartition("/")[2]: each for each in rviz["Displays"]}
    assert {rviz["Global Options"]["Fixed Frame"], shown["Grid"]["Reference Frame"]} <= frames
    assert recorded[shown["MarkerArray"]["Topic"]["Value"]] == "visualization_msgs/msg/MarkerArray"
    assert recorded["/tf"] == "tf2_msgs/msg/TFMessage"
    markers = [marker for each in typed(file, "/scene") for marker in each.markers]
    assert {marker.header.frame_id for marker in markers} <= frames
