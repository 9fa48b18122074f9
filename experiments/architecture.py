"""What `zenpark check` says of an architecture that is not distributed."""

from __future__ import annotations

from collections.abc import Iterator

from agents import plugins
from experiments.analysis import Analysis
from experiments.assign import guided
from experiments.claim import Claim, listed


def architecture(analysis: Analysis) -> Iterator[Claim]:
    """Who decides for whom, what happens when the centre is gone, and whether the trigger suits that."""
    experiment, path = analysis.experiment, ("architecture",)
    steered = guided(experiment)
    if not steered:
        return
    everyone, rate = len(steered) == len(experiment.robots), experiment.rates.coordination_hz
    whom = f"all {len(steered)} robots" if everyone else listed(steered)
    rest = "" if everyone else "; the others decide for themselves, and hear these as before"
    hold = f"if it is gone, or its goals are older than {experiment.safety.link_silence_s:g} s, they hold"
    what = "centralised" if everyone else "hybrid"
    yield Claim("note", what, f"{what}: a centre decides for {whom} {rate:g} times a second{rest}; {hold}", "", path)
    if experiment.safety.link_silence_s <= 1.0 / rate:
        message = f"goals come every {1.0 / rate:g} s, and are too old after {experiment.safety.link_silence_s:g} s"
        remedy = "give safety.link_silence_s more than twice that, or decide more often"
        yield Claim("error", "goals-too-old", message, remedy, ("safety", "link_silence_s"))
    kind, _ = plugins.split(experiment.trigger)
    if getattr(plugins.struct(plugins.TRIGGERS, kind), "judges_errors", False):
        message = (
            f"the trigger '{kind}' judges by the formation error, which robots that are guided do not know: it is 0"
        )
        yield Claim("warning", "error-unknown", message, "take another one, such as send-on-delta", ("trigger",))
