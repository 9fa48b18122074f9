"""Robots as points that run one law and hear each other over a network that loses messages: no body, no clock."""

from __future__ import annotations

from math import isfinite, nan
from random import Random

from agents.decision.stepping import rounded
from agents.formation.link import Link
from agents.plugins.law import NeighbourView, RobotFacts, View
from agents.vectors import ZERO
from experiments.catalogue import index
from experiments.check.check import check
from experiments.file import document


class Talking:
    """Points at `places` with a law; `pairs` hear each other, both ways."""

    def __init__(self, law, places, pairs, *, loss=0.0, seed=0, step_s=0.1, every=1):
        self.law, self.loss, self.random, self.step_s, self.every = law, loss, Random(seed), step_s, every
        self.places, self.rounds = [(x, y, 0.0) for x, y in places], 0
        names = [f"R{number}" for number in range(len(places))]
        self.facts = [RobotFacts(each, n, len(names), True, 1.0, step_s) for n, each in enumerate(names)]
        self.memory = [law.begin(each) for each in self.facts]
        self.said = list(self.memory)
        unknown = {name: (nan,) * len(self.memory[0][name]) for name in law.SAYS}
        self.heard = {way: unknown for i, j in pairs for way in ((i, j), (j, i))}  # by receiver and sender
        self.controls = []

    def round(self):
        """All step; then they speak, every so often."""
        self.controls = [self._step(number) for number in range(len(self.facts))]
        self.memory = [each.memory for each in self.controls]
        for number, control in enumerate(self.controls):
            if control.velocity is not None:
                self.places[number] = tuple(
                    p + self.step_s * v if isfinite(v) else p
                    for p, v in zip(self.places[number], control.velocity, strict=True)
                )
        self.rounds += 1
        if self.rounds % self.every == 0:
            self.said = [{name: tuple(map(rounded, each[name])) for name in self.law.SAYS} for each in self.memory]
            for receiver, sender in self.heard:
                if self.random.random() >= self.loss:
                    self.heard[receiver, sender] = self.said[sender]
        return self

    def _step(self, number):
        neighbours = [
            NeighbourView(j, self.facts[j].name, self.places[j], ZERO, nan, 0.0, words, Link())
            for (i, j), words in self.heard.items()
            if i == number
        ]
        view = View(self.facts[number], self.said[number], neighbours)
        view.position, view.time = self.places[number], self.rounds * self.step_s
        return self.law.step(view, self.memory[number])


def law_findings(name, *changes):
    """Severity, message and remedy of what a check finds about the law of an experiment of the catalogue."""
    found = check(document.read(index.find_file(name), changes), ["periodic"])
    return [(each.severity, each.message, each.remedy) for each in found if each.code == "law"]


def one_way(name, link):
    """What a law says of such an experiment if this link goes one way."""
    text = index.find_file(name).read_text("utf-8").replace(link, link.replace(" - ", " > "))
    plan = document.loads(text).cases()["periodic"]
    ((severity, message, remedy),) = plan.law.analyse(plan)
    assert severity == "error"
    return message, remedy
