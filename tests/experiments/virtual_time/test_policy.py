"""A learned policy acts in flight as it does offline, and is refused where it does not fit."""

import math
import runpy
import sys
from base64 import b64decode, b64encode
from pathlib import Path

import numpy as np
import pytest

from agents.body.interface import RangeScan
from agents.decision.stepping import Stepping
from agents.formation.link import Link
from agents.plugins.extras import policy
from agents.plugins.extras.observation import Observation
from agents.plugins.extras.policy import Policy, PolicyTrigger
from agents.plugins.law import NeighbourView, RobotFacts, View
from agents.plugins.registry import PluginError
from agents.plugins.triggers import TriggerView
from agents.vectors import UNKNOWN, ZERO
from experiments.catalogue import index
from experiments.file import document
from experiments.file.document import DocumentError
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate
from tests.agents.learned import learned, learned_bytes

pytest.importorskip("onnxruntime", reason="the law policy is the extra [policy]: ./zenpark install onnxruntime")
onnx = pytest.importorskip("onnx", reason="policies are written with onnx")

SHAPE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def offline(observations):
    """Actions (K, 2) of the catalogue's policy for observations (K, 16), by its weights, with numpy alone."""
    graph = onnx.load(index.FOLDER / "policy.onnx").graph
    w1, b1, w2, b2, w3, b3 = (onnx.numpy_helper.to_array(each).astype(float) for each in graph.initializer)
    return np.tanh(np.tanh(observations @ w1 + b1) @ w2 + b2) @ w3 + b3


@pytest.mark.slow
@pytest.mark.parametrize(("case", "most"), [("periodic", 0.03), ("event", 0.04), ("event-loss", 0.04)])
def test_a_policy_acts_in_flight_as_offline(case, most, monkeypatch):
    seen, acted, step = [], [], Policy.step

    def watched(self, view, memory):
        control = step(self, view, memory)
        seen.append(policy.load(self.model)[0].of(view))
        acted.append(control.velocity[:2])
        return control

    monkeypatch.setattr(Policy, "step", watched)
    plan = document.read("policy").cases()[case]
    known = RunRecorder(simulate(plan, plan.experiment.seed), plan, case).trace()
    assert len(acted) > 4 * 190
    assert np.array(acted) == pytest.approx(offline(np.array(seen)), abs=1e-6)
    place = known.true_position[..., :2] - SHAPE
    apart = np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    assert apart[-1] < most < 0.5 < apart[0]


@pytest.mark.parametrize("trained", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_the_policy_imitates_its_expert(tmp_path, trained):
    training = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "policy_training.py"))
    situations = training["situations"](np.random.default_rng(3), 5000)
    actions = offline(situations)
    if trained:
        training["write"](training["train"](), tmp_path / "new.onnx")
        _, new = policy.load(b64encode((tmp_path / "new.onnx").read_bytes()).decode())
        actions = np.array([new.act(each, ())[0] for each in situations])
    assert np.sqrt(((actions - training["expert"](situations)) ** 2).sum(axis=1).mean()) < 0.015


def test_observations():
    facts = RobotFacts("B", 1, 3, flies=False, speed=0.2, step_s=0.1)
    near = NeighbourView(0, "A", (1.0, 2.0, 0.0), ZERO, 0.0, 0.0, {}, Link(relative=(0.5, -0.5, 0.0)))
    bare = NeighbourView(2, "C", (0.0, 0.5, 0.0), ZERO, 0.0, 0.0, {}, Link(relative=UNKNOWN))
    view = View(facts, {}, [near, bare])
    view.position, view.velocity = (0.2, 0.1, 0.0), UNKNOWN
    expected = [0.2, 0.1, 0, 0, 0.8, 1.9, -0.5, 0.5, -0.2, 0.4, 0, 0]
    for count, wanted in ((1, expected[:8]), (2, expected), (3, [*expected, 0, 0, 0, 0])):
        assert Observation(places=count).of(view) == pytest.approx(wanted)


def model(folder, inputs, outputs, kind=1):
    """File of a policy that is a matrix of zeros."""
    (folder / "own.onnx").write_bytes(learned_bytes(inputs, outputs, kind=kind))


def own_policy(folder, name="own.onnx"):
    """Experiment with a policy that is beside it."""
    text = index.find_file("policy").read_text("utf-8").replace("policy.onnx", name)
    (folder / "own.toml").write_text(text, "utf-8")
    return document.read(folder / "own.toml", [])


def test_what_is_no_policy_is_refused(tmp_path, monkeypatch):
    faults = {
        (15, 2): r"needs a model of 4 \+ 4n inputs; this has 15",
        (16, 3): "output of 2 numbers; this gives 3",
        (16, 2, 11): r"one float input .* this has o: tensor\(double\)",
        (3, 2): r"needs a model of 4 \+ 4n inputs; this has 3",
    }
    for sizes, fault in faults.items():
        model(tmp_path, *sizes)
        given = own_policy(tmp_path).cases()["periodic"].assignment("CF01")
        with pytest.raises(PluginError, match=fault):
            Stepping(given)
    (tmp_path / "own.onnx").write_bytes(b"nothing")
    given = own_policy(tmp_path).cases()["periodic"].assignment("CF01")
    with pytest.raises(PluginError, match="cannot use its file"):
        Stepping(given)
    with pytest.raises(PluginError, match="give `file`"):
        policy.load("")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(PluginError, match=r"\./zenpark install onnxruntime"):
        policy.load("not cached")


def test_weights_in_a_second_file_are_explained(tmp_path):
    file = tmp_path / "two.onnx"
    made = onnx.load_from_string(learned_bytes(16, 2))
    onnx.save(made, str(file), save_as_external_data=True, location="two.onnx.data", size_threshold=0)
    with pytest.raises(PluginError, match="external_data=False"):
        policy.load(b64encode(file.read_bytes()).decode())


def test_an_action_in_one_column_is_read():
    """A network of scikit-learn, as skl2onnx 1.20 writes it, declares one number and gives two rows of one."""
    made = onnx.load_from_string(learned_bytes(16, 2, weights=((1.0, 0.0), *[(0.0, 2.0)] * 15)))
    column = onnx.numpy_helper.from_array(np.array([-1, 1]), "column")
    made.graph.initializer.append(column)
    made.graph.node.append(onnx.helper.make_node("Reshape", ["v", "column"], ["w2"]))
    made.graph.output[0].CopyFrom(onnx.helper.make_tensor_value_info("w2", 1, [None, 1]))
    _, read = policy.load(b64encode(made.SerializeToString()).decode())
    assert read.act([1.0] * 16, ())[0] == (1.0, 30.0)


def test_absent_file_is_a_fault_of_its_line(tmp_path):
    (tmp_path / "long.onnx").write_bytes(bytes(1_000_001))
    faults = {"own": r"own\.onnx cannot be read", "../own": "is no name of a file", "long": "is longer than 1 MB"}
    for name, fault in faults.items():
        with pytest.raises(DocumentError, match=fault):
            own_policy(tmp_path, f"{name}.onnx")


def test_a_model_goes_with_the_experiment(tmp_path):
    model(tmp_path, 8, 2)
    given = own_policy(tmp_path)
    law = given.cases()["event"].experiment.formation.law
    assert b64decode(law["model"]) == (tmp_path / "own.onnx").read_bytes()
    (tmp_path / "run").mkdir()
    given.keep(tmp_path / "run" / "experiment.toml")
    assert document.read(tmp_path / "run" / "experiment.toml", []).experiment == given.experiment
    (tmp_path / "own.onnx").unlink()
    (tmp_path / "own.json").write_bytes(document.write_json(given.plan))
    assert document.read(tmp_path / "own.json", []).experiment.formation.law == law
    (tmp_path / "own.onnx").write_bytes(b"of another machine")
    case = document.case_document(given.cases()["event"], "event").decode()
    assert document.received(case, str(tmp_path / "pipe")).experiment.formation.law == law


def test_more_neighbours_than_places_are_a_warning(tmp_path):
    model(tmp_path, 8, 2)
    plan = own_policy(tmp_path).cases()["periodic"]
    severity, message, _ = next(iter(plan.law.analyse(plan)))
    assert (severity, message.partition(",")[0]) == ("warning", "CF01 has 3 neighbours")


def test_metadata_name_observations_and_action():
    facts = RobotFacts("B", 1, 3, flies=False, speed=0.2, step_s=0.1)
    near = NeighbourView(0, "A", (1.0, 2.0, 0.0), (0.1, 0.0, 0.0), 0.0, 0.4, {}, Link(relative=(0.5, -0.5, 0.0)))
    view = View(facts, {}, [near])
    view.position, view.target, view.deviation, view.yaw = (0.2, 0.1, 0.7), (1.0, 0.0, 0.7), 0.03, math.pi
    view.scan = RangeScan(0.0, (0.1, 1.6), (0.0, 0.0), (2.0, 0.5))
    about = {"observes": "height yaw target deviation scan:4", "observes_each": "place moves age"}
    observation, found = policy.load(learned(20, 2, bias=0.25, action="goal", **about))
    expected = [0.7, -1.0, 0.0, 0.8, -0.1, 0.03, 0.5, 2.0, 0.0, 0.0, 0.8, 1.9, 0.1, 0.0, 0.4]
    assert observation.of(view) == pytest.approx([*expected, 0, 0, 0, 0, 0], abs=1e-12)
    control = Policy(model=learned(20, 2, bias=0.25, action="goal", **about)).step(view, {})
    assert control.goal == pytest.approx((0.45, 0.35, math.nan), nan_ok=True)
    assert found.memory == 0


def test_recurrent_policies_remember():
    law = Policy(model=learned(4, 2, memory=3, observes_each=""))
    robot = RobotFacts("B", 1, 3, flies=False, speed=0.2, step_s=0.1)
    view, memory = View(robot, {}, []), law.begin(robot)
    view.position = (0.2, 0.1, 0.0)
    wanted = []
    for _ in range(3):
        control = law.step(view, memory)
        memory = control.memory
        wanted.append(control.velocity[0])
    assert wanted == pytest.approx([0.0, 0.9, 1.35], abs=1e-6)


@pytest.mark.parametrize(
    ("about", "fault"),
    [
        ({"observes": "position speed"}, "cannot observe 'speed'; known: position, .*"),
        ({"observes": "position scan:x"}, "cannot observe 'scan:x'; known: position, .*, scan:8"),
        ({"observes_each": "plac"}, "cannot observe 'plac'; known: place, wanted, distance, moves, age"),
        ({"observes_each": ""}, r"needs a model of 4 \+ 0n inputs; this has 16"),
        ({"action": "force"}, "action = 'force'; take one of velocity, goal"),
    ],
)
def test_metadata_that_are_nonsense_are_refused(about, fault):
    with pytest.raises(PluginError, match=fault):
        policy.load(learned(16, 2, **about))


def test_learned_triggers_fire_above_zero():
    trigger = PolicyTrigger(model=learned(3, 1, bias=-0.02, weights=((1.0,), (0.0,), (0.0,))))
    view = TriggerView({})
    for deviation, fires in ((0.01, False), (0.03, True), (math.inf, True), (math.nan, False)):
        view.deviation, view.error = deviation, math.nan
        assert trigger.fires(view) == fires
    with pytest.raises(PluginError, match=r"3 inputs .* and one output; this has 4 and 1"):
        PolicyTrigger(model=learned(4, 1)).fires(view)
    with pytest.raises(PluginError, match="trigger policy has no model: give `file`"):
        PolicyTrigger().fires(view)
