"""Orders of the page: who may give them, and which parameters have sliders."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from agents.network import lab
from agents.network.endpoints import free_endpoint
from experiments.file.document import load
from experiments.run import simulate, simulate_seeds
from experiments.scene.stage import SceneModel
from experiments.view.acting import Watched, may_act, parameters


def test_only_an_operator_of_a_lab_gives_orders(tmp_path):
    known = {
        name: lab.Identity(role=role, common_name=name, serial="1", until="2027-01-01T00:00:00")
        for name, role in (("operator", "operator"), ("observer", "observer"), ("ana", "operator"))
    }
    (tmp_path / lab.REGISTER).write_bytes(msgspec.json.encode(lab.Register(known)))
    endpoints = lab.secured(["tls/127.0.0.1:7447"], tmp_path)
    found = {name: may_act(Watched(endpoints, "park", name)) for name in (*known, "stranger")}
    assert found == {"operator": True, "observer": False, "ana": True, "stranger": False}
    assert [may_act(Watched(["tcp/127.0.0.1:7447"], "park", name)) for name in ("operator", "observer")] == [
        True,
        False,
    ]
    assert not may_act(Watched(lab.secured(["tls/127.0.0.1:7447"], tmp_path / "no"), "park", "operator"))


def test_trigger_and_law_numbers_have_sliders():
    park = SceneModel.of_plan(load("robotic-park").cases()["event"])
    assert [(each.label, each.value) for each in parameters(park)] == [
        ("trigger.threshold [m]", 0.01), ("clamp [m]", 0.1), ("tracking_gain [1/(m²·decision)]", 3.0),
    ]  # fmt: skip


@pytest.mark.slow
def test_watched_virtual_run_is_unchanged_bit_by_bit():
    pytest.importorskip("viser", reason="needs viser")
    from experiments.view import paced  # noqa: PLC0415
    from experiments.view.serving import served  # noqa: PLC0415

    read = load("robotic-park", "duration_s=1.0", "timeline=[]", "cases={}")
    with served(int(free_endpoint(preferred_port=0).rpartition(":")[2]), dark=True) as server:
        page = paced.PacedView(server, pace=100.0, dark=True, page_s=0.0)
        (watched,) = simulate_seeds(read, [1], watch=page.begin)
    alone = simulate(read, seed=1)
    for case, trace in alone.traces.items():
        np.testing.assert_array_equal(watched.traces[case].true_position, trace.true_position)
    assert page.clock.t > 0.0
