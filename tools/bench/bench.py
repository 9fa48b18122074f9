"""`./zenpark bench`: speed of this machine; each figure with a ratio to a baseline that was measured in the same run.

Machines are noisy and differ: a figure alone says little. CPU times are medians.
"""

from __future__ import annotations

from typing import Annotated, Final

import typer

from tools.commands.options import AsJson, example, known_words, print_json

app: Final = typer.Typer()

BENCHMARKS: Final = {  # module, which has a function of the benchmark's name
    "start": "measuring",  # time until a command answers
    "virtual": "measuring",  # the reference experiment in virtual time
    "process": "process",  # CPU and memory of robot processes
    "safety": "reactions",  # reaction times
}


@app.command(epilog=example("bench", "bench process --json"))
def bench(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME...]", help=f"Of: {', '.join(BENCHMARKS)}. [all]", autocompletion=lambda: list(BENCHMARKS)
        ),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Measure what this machine can do, each figure beside a baseline."""
    from importlib import import_module

    figures = []
    for name in known_words("bench", names or [], BENCHMARKS) or BENCHMARKS:
        for figure in getattr(import_module(f"tools.bench.{BENCHMARKS[name]}"), name)():
            figures.append(figure)
            if not as_json:
                value = f"{figure.name:<50} {figure.value:10.3g} {figure.unit:<12}"
                print(f"{figure.benchmark:<10} {value} {figure.ratio:8.3g} {figure.baseline}", flush=True)
    if as_json:
        print_json(figures)
    return 0
