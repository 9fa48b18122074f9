"""Variables that robots transmit with their poses: places in the scene, measures in the table."""

from __future__ import annotations

from math import isfinite

import numpy as np
import pytest

from experiments.file.document import load
from experiments.scene import models, tracks
from experiments.scene.stage import Condition, SceneModel
from experiments.view.panel import RobotRow, table
from experiments.view.replay import Film
from tests.runs import recorded

SHORT = ("duration_s=3.0",)


@pytest.fixture(scope="module")
def flown():
    """A recorded run of a law that says a place, as the trace in memory and as a replay."""
    run = recorded("aggregative", *SHORT, cases=("event",))
    return run.traces["event"], Film(tracks.read(run.folder / "event.mcap"))


def test_said_places_are_those_of_the_memory(flown):
    trace, film = flown
    assert dict(film.stage.place_variables) == {"s": 0}
    for k in range(5, len(trace.time), 31):
        moment = film.moment(float(trace.time[k]))
        assert moment.places.shape == (len(trace.robots), 1, 3)
        assert moment.places[:, 0, :2] == pytest.approx(trace.memory["s"][k], abs=1e-6)
        assert moment.places[:, 0, 2] == pytest.approx(moment.position[:, 2])  # it says no z


def test_places_with_z_and_unknown_ones():
    stage = SceneModel.of_plan(load("aggregative", *SHORT).cases()["event"])
    position = np.full((len(stage.names), 3), 0.7)
    memories = [{"s": (1.0, 2.0, 3.0)}, {"s": (1.0, 2.0)}, {"s": (1.0, 2.0, 3.0, 4.0)}, {"s": (1.0,)}, {}]
    places = stage.said_places(memories, position)[:, 0]
    assert places[:3].tolist() == [[1.0, 2.0, 3.0], [1.0, 2.0, 0.7], [1.0, 2.0, 0.7]]
    assert np.isnan(places[3:]).all()
    assert not SceneModel.of_robots(("A",)).place_variables
    planned = SceneModel.of_plan(load("mpc", *SHORT).cases()["event"])
    path = tuple(float(number) for number in range(32))
    assert planned.said_places([{"path": path}], position)[0].tolist() == [[30.0, 31.0, 0.7]]


def test_measures_stand_in_the_table(flown):
    trace, film = flown
    rows = film.rows(2.0)
    assert set(rows[0].measures) == set(trace.measures)
    assert all(isfinite(each) for row in rows for each in row.measures.values())
    text = table(rows, film.stage)
    assert all(name in text for name in list(trace.measures)[:3])
    bold = RobotRow("A", Condition.ACTIVE, measures={"<b>": 0.12345})
    assert table([bold], SceneModel.of_robots(("A",))).count("&lt;b&gt;") == 1


def test_a_mark_is_closed_and_looks_outward():
    mesh = models.diamond(0.03)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, corners.mean(axis=1)) > 0.0).all()
    assert np.abs(normals.sum(axis=0)).max() < 1e-12
