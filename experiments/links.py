"""The links of a formation as the file writes them: "A > B" (B listens to A), "A - B" (both listen)."""

from __future__ import annotations

import re
from typing import Final

from experiments.experiment import Experiment, Link

_LINK: Final = re.compile(r"\s*(\w+)\s*([>-])\s*(\w+)\s*", re.ASCII)
_ALMOST: Final = re.compile(r"\s*(\w+)\s*([^\w\s]+)\s*(\w+)\s*", re.ASCII)
FORM: Final = 'a link reads "A > B" (B listens to A) or "A - B" (both listen)'


def pairs(text: str) -> tuple[tuple[str, str], ...]:
    """The (listener, speaker) pairs that a link stands for, one or two.

    Raises:
        ValueError: If it reads otherwise; the message is what to write instead.
    """
    match = _LINK.fullmatch(text)
    if match is None:
        raise ValueError(_remedy(text))
    first, sign, second = match.groups()
    return ((second, first),) if sign == ">" else ((second, first), (first, second))


def parse_links(experiment: Experiment) -> list[tuple[str, str, float, float]]:
    """Every directed link as (listener, speaker, distance [m], gain), in the robots' order: by listener, then speaker.

    Raises:
        ValueError: If a link is not written as it must be; never for an experiment that `document.read` returned.
        KeyError: If it names no robot; likewise.
    """
    row = {name: number for number, name in enumerate(experiment.robots)}
    found = []
    for text, link in experiment.formation.links.items():
        distance, gain = (link.distance, link.gain) if isinstance(link, Link) else (link, None)
        for listener, speaker in pairs(text):
            found.append((listener, speaker, distance, experiment.formation.gain if gain is None else gain))
    return sorted(found, key=lambda link: (row[link[0]], row[link[1]]))


def _remedy(text: str) -> str:
    almost = _ALMOST.fullmatch(text)
    if almost is None:
        return FORM
    first, sign, second = almost.groups()
    if "<" in sign and ">" in sign:
        return f'write "{first} - {second}" when both listen'
    if "<" in sign:
        return f'write "{second} > {first}" when {first} listens to {second}'
    if ">" in sign:
        return f'write "{first} > {second}" when {second} listens to {first}'
    return f'write "{first} > {second}" when {second} listens to {first}, "{first} - {second}" when both listen'
