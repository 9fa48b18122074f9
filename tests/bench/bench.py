"""`./zenpark test --bench`: speed of this machine; each figure with a ratio to a baseline of the same run.

Machines are noisy and differ: a figure alone says little. CPU times are medians.
"""

from typing import Annotated, Final

import typer

from tests.bench import learning, measuring, process, reactions
from tools.options import AsJson, known_words, print_json

BENCHMARKS: Final = {
    "start": measuring.start,  # time until a command answers
    "virtual": measuring.virtual,  # the reference experiment in virtual time
    "learning": learning.learning,  # decisions in an environment
    "process": process.process,  # CPU and memory of robot processes
    "safety": reactions.safety,  # reaction times
}


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME...]", help=f"Of: {', '.join(BENCHMARKS)}. [all]")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Measure what this machine can do, each figure beside a baseline."""
    figures = []
    for name in known_words("--bench", names or [], BENCHMARKS) or BENCHMARKS:
        for figure in BENCHMARKS[name]():
            figures.append(figure)
            if not as_json:
                value = f"{figure.name:<50} {figure.value:10.3g} {figure.unit:<12}"
                print(f"{figure.benchmark:<10} {value} {figure.ratio:8.3g} {figure.baseline}", flush=True)
    if as_json:
        print_json(figures)
    return 0
