"""The page on learning runs as it stands, and what its training left flies better than what imitates a law."""

import re
import runpy
from base64 import b64encode

import numpy as np
import pytest

from tests.commands import ROOT

pytest.importorskip("pettingzoo", reason="environments are the extra [learn]: ./zenpark install pettingzoo gymnasium")
pytest.importorskip("onnx", reason="policies are written with onnx")

from agents.plugins.extras import policy
from experiments.catalogue import index

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def training():
    return runpy.run_path(str(DOCS / "learning_training.py"))


def text_of(file):
    return b64encode(file.read_bytes()).decode()


def flown_with(training, file, case, trigger="", seed=5000):
    observation, model = policy.load(text_of(file))

    def act(seen):
        return np.array([model.act(row, ())[0] for row in seen.tolist()])

    return training["fly"](act, case, seed, trigger, " ".join(observation.each))


@pytest.mark.slow
def test_examples_of_the_page_run():
    space = {"__name__": "page"}
    for block in re.findall(r"^```python\n(.*?)^```", (DOCS / "learning.md").read_text("utf-8"), re.M | re.S):
        exec(compile(block, "learning.md", "exec"), space)
    assert space["best"] == 0.8


@pytest.mark.slow
def test_what_was_learned_beats_the_imitator(training):
    """In all cases, with and without the trigger that was learned; with it, it rests and spares messages."""
    trigger = text_of(DOCS / "learned-trigger.onnx")
    for case in training["CASES"]:
        imitated, _, _ = flown_with(training, index.FOLDER / "policy.onnx", case)
        alone = flown_with(training, DOCS / "learned.onnx", case)
        flown = [flown_with(training, DOCS / "learned.onnx", case, trigger, seed) for seed in (5000, 5001)]
        total, rest, messages = np.mean(flown, axis=0)
        assert min(alone[0], total) > 0.85 * imitated
        assert rest < 0.03
        assert messages <= 150


def test_a_strategy_of_evolution_finds_a_minimum(training):
    def measure(candidates, _generation):
        return -((candidates - [1.0, -2.0]) ** 2 * [1.0, 30.0]).sum(axis=1)

    assert training["evolve"](np.zeros(2), 0.5, 40, 8, measure) == pytest.approx([1.0, -2.0], abs=1e-3)


def test_models_are_what_was_learned(training):
    numbers = np.array([0.1, 1.4, 2.9, 0.3, 0.1, 0.05, -0.2, -1.0])
    seen = abs(np.random.default_rng(1).normal(size=(20, 25)))
    observation, model = policy.load(b64encode(training["policy_model"](numbers)).decode())
    parts = " ".join((*observation.own, *observation.each))
    assert (parts, observation.places) == (f"position velocity {training['EACH']}", 3)
    found = np.array([model.act(row, ())[0] for row in seen.tolist()])
    assert found == pytest.approx(training["policy_of"](numbers)(seen), abs=1e-5)
    trigger = policy.load_trigger(b64encode(training["trigger_model"](np.array([-3.0, 1.0, 2.0]))).decode())
    assert trigger.act([0.05, 0.1, 0.2], ())[0][0] == pytest.approx(0.05 + 0.001 + 0.004 - np.exp(-3.0), abs=1e-6)
